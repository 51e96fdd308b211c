"""How something was made, as folded text of a report."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from scanchain.runs.provenance import Provenance
from scanchain.viz.report.page import Fold


def provenance_folds(made: Provenance, others: dict[str, str]) -> Iterator[Fold]:
    """The command, and the versions that it ran with."""
    yield Fold("Command", shlex.join(made.command))
    versions = {"python": made.python} | made.versions | others
    yield Fold("Versions", "\n".join(f"{name} {number or 'not installed'}" for name, number in versions.items()))
    yield Fold(
        "Log files", "\n".join(f"{log.path}  {log.size_bytes:,} bytes  sha256 {log.sha256}" for log in made.logs)
    )
