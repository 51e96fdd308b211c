"""Number of threads that a process and those it starts may use; the results do not depend on it."""

from __future__ import annotations

import os

VARIABLE = "SCANCHAIN_THREADS"
MOST = 256  # largest number of threads that is accepted


def use_threads(count: int) -> None:
    """Use ``count`` threads from now on."""
    os.environ[VARIABLE] = str(count)


def threads() -> int:
    """Number of threads for what is computed in parts; by default one for each core that this process may use."""
    text = os.environ.get(VARIABLE, "")
    if text.isdigit() and int(text):
        return min(int(text), MOST)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
