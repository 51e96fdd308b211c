"""A finding of the doctor, and its severity."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Severity(StrEnum):
    """Severity of a finding for a run."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check.

    Attributes
    ----------
    check : what was looked at, one word or two
    found : what was measured, with units
    effect : what it does to the result, empty where it does nothing
    remedy : flags of ``scanchain run`` that help, as they are typed and nothing else; empty where none does
    """

    check: str
    severity: Severity
    found: str
    effect: str = ""
    remedy: str = ""
