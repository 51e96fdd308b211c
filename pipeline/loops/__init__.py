"""Loop closure: place recognition, verification, relocalization; and the trajectory of all scans at the end."""

from scanchain.loops.closer import LoopCloser
from scanchain.loops.closure_table import ClosureTable
from scanchain.loops.evidence import MapEvidence
from scanchain.loops.outline import outline_of
from scanchain.loops.refinement import refined, spread

__all__ = ["ClosureTable", "LoopCloser", "MapEvidence", "outline_of", "refined", "spread"]
