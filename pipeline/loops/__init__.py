"""Loop closure: place recognition, verification, relocalization; and the trajectory of all scans at the end."""

from scanchain.loops.closer import LoopCloser
from scanchain.loops.outline import outline_of
from scanchain.loops.refinement import refined, spread

__all__ = ["LoopCloser", "outline_of", "refined", "spread"]
