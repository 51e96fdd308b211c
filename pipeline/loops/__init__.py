"""Propose and verify revisits, and let every scan have its share of what they tell."""

from scanchain.loops.closer import LoopCloser
from scanchain.loops.refinement import refined
from scanchain.loops.spreading import spread

__all__ = ["LoopCloser", "refined", "spread"]
