"""Diagnosis of a log: its faults, their effect on the result, and the flags that fix them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scanchain.config import Config, LogConfig
from scanchain.logs.doctor.checks_scans import check_scans
from scanchain.logs.doctor.checks_time import check_time
from scanchain.logs.doctor.finding import Finding, Severity
from scanchain.logs.doctor.statistics import survey
from scanchain.logs.log import open_log
from scanchain.source import Source

_ORDER = tuple(reversed(Severity))


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The findings about a log, the gravest first.

    ``notes`` are what opening it assumed, ``idle_keys`` the settings that have no effect on it, and why.
    """

    files: tuple[str, ...]
    topic: str
    dimension: int
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    idle_keys: dict[str, str]


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
    config = config_of(log.dimension)
    findings = [*check_time(seen, config), *check_scans(seen, config.preprocess)]
    ordered = sorted(findings, key=lambda finding: _ORDER.index(finding.severity))
    return Diagnosis(tuple(map(str, log.paths)), log.topic, log.dimension, tuple(ordered), notes, log.idle_keys())
