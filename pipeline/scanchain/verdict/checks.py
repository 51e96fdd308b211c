"""The checks of a trajectory, in the order in which they are made and listed.

A new check is a class derived from ``Check``, in a file of this package, and a line here: its values become a
column of steps.parquet and, with a limit, a curve in the report; its findings and reasons, part of the verdict.
"""

from __future__ import annotations

from scanchain.verdict.evidence import Check
from scanchain.verdict.loops import Connections, Loops
from scanchain.verdict.scans import Copies, Overlap, States, Velocity
from scanchain.verdict.wheels import Wheels

CHECKS: tuple[type[Check], ...] = (States, Overlap, Velocity, Wheels, Copies, Loops, Connections)
