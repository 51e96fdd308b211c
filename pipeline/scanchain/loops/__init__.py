"""Loop closure: place recognition, verification, relocalization; and the trajectory of all scans at the end."""

from scanchain.loops.closer import LoopCloser
from scanchain.loops.closure_table import ClosureTable
from scanchain.loops.evidence import SequentialPlaceTest
from scanchain.loops.refinement import refined, spread
from scanchain.loops.upright_search import level_of, outline_of

__all__ = ["ClosureTable", "LoopCloser", "SequentialPlaceTest", "level_of", "outline_of", "refined", "spread"]
