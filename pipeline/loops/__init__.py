"""Loop closure: place recognition, verification, relocalization; and the trajectory of all scans at the end."""

from scanchain.loops.closer import LoopCloser
from scanchain.loops.refinement import refined, spread

__all__ = ["LoopCloser", "refined", "spread"]
