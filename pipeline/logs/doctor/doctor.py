"""Diagnosis of a log: its faults, their effect on the result, and the flags that fix them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scanchain.config import Config, LogConfig
from scanchain.logs.doctor.checks import Finding, Severity, check
from scanchain.logs.doctor.statistics import survey
from scanchain.logs.log import open_log
from scanchain.source import Source

_ORDER = tuple(reversed(Severity))


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The findings about a log, the gravest first; ``notes`` are what opening it assumed."""

    files: tuple[str, ...]
    topic: str
    dimension: int
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]


def examine(
    sources: Sequence[Source],
    config_of: Callable[[int], Config],
    log_config: LogConfig,
    progress: Callable[[int, int], None] | None = None,
) -> Diagnosis:
    """Diagnosis from every scan of a log. Raises InputError where a run could not open it either.

    config_of : what a run would use for a log of this dimension
    """
    log = open_log(sources, log_config)
    notes = tuple(log.notes)
    seen = survey(log, progress)
    ordered = sorted(check(seen, config_of(log.dimension)), key=lambda finding: _ORDER.index(finding.severity))
    return Diagnosis(tuple(map(str, log.paths)), log.topic, log.dimension, tuple(ordered), notes)
