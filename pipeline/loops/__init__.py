"""Propose and verify revisits."""

from pipeline.loops.closer import LoopCloser

__all__ = ["LoopCloser"]
