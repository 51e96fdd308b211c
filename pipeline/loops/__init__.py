"""Propose and verify revisits, and let every scan have its share of what they tell."""

from pipeline.loops.closer import LoopCloser
from pipeline.loops.refinement import refined
from pipeline.loops.spreading import spread

__all__ = ["LoopCloser", "refined", "spread"]
