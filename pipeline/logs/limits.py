"""How near and how far a return may be to be taken from the log."""

from typing import NamedTuple


class RangeLimits(NamedTuple):
    """Metres; what lies outside is dropped at the reader and counted."""

    min_m: float
    max_m: float
