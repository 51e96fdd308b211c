"""The table of a comparison, made of its evidence."""

from __future__ import annotations

import msgspec
import numpy as np

from scanchain.baselines import BASELINES
from scanchain.comparison.evidence import Evidence
from scanchain.comparison.figures import Figures
from scanchain.comparison.judging import doubt, representative
from scanchain.comparison.maps import sharpness_of
from scanchain.comparison.methods import Method
from scanchain.comparison.outcome import EndReport, Status
from scanchain.comparison.table import Row, Table
from scanchain.evaluation import Sharpness, disagreement
from scanchain.logs import Log
from scanchain.runs.provenance import Provenance, package_version
from scanchain.watched import Limits


def summarize(evidence: Evidence, log: Log, limits: Limits, provenance: Provenance) -> Table:
    """Every method's row, with what only all of them together tell: sharpness and disagreement."""
    scans, sharp = evidence.scans, sharpness_of(evidence.maps)
    finals = [representative(evidence.outcomes[method.name]).trajectory.poses for method in evidence.methods]
    apart_m = disagreement(finals)
    rows = [
        _row(evidence, method, sharp.get(method.name), np.delete(apart_m[place], place))
        for place, method in enumerate(evidence.methods)
    ]
    packages = sorted({BASELINES[method.base].package for method in evidence.methods if method.base in BASELINES})
    return Table(
        log=", ".join(str(path) for path in log.paths),
        topic=log.topic,
        dimension=scans.dimension,
        scans=len(scans),
        points_per_scan=float(scans.points.mean()),
        repeats=max(len(runs) for runs in evidence.outcomes.values()),
        truth=evidence.reference.source,
        truth_note=evidence.reference.note,
        rows=rows,
        disagreement_m=[[value if np.isfinite(value) else None for value in row] for row in apart_m.tolist()],
        notes=[
            f"every run may take {limits.time_s:,.0f} s and {limits.memory_mib / 1024.0:.1f} GiB",
            *log.notes,
            *log.damage,
        ],
        provenance=provenance,
        baselines={name: _installed(name) for name in packages},
    )


def _row(evidence: Evidence, method: Method, sharp: Sharpness | None, apart_m: np.ndarray) -> Row:
    outcomes, judged = evidence.outcomes[method.name], evidence.judged[method.name]
    end = _end([outcome.report for outcome in outcomes])
    known = apart_m[np.isfinite(apart_m)]
    figures: Figures = msgspec.structs.replace(
        judged.figures,
        thickness_m=sharp.thickness_m if sharp else None,
        entropy=sharp.mean_map_entropy if sharp else None,
        disagreement_m=float(np.median(known)) if len(known) else None,
    )
    return Row(
        name=method.name,
        base=method.base,
        status=end.status,
        reason=end.reason,
        description=representative(outcomes).report.description,
        doubt=doubt(representative(outcomes)),
        settings=method.settings,
        figures=figures,
        definitions=list(judged.definitions),
    )


def _end(reports: list[EndReport]) -> EndReport:
    """How it ended: badly if one run did."""
    return next((report for report in reports if report.status is not Status.OK), reports[0])


def _installed(package: str) -> str:
    """Of a package, which may come under the name of its variant without CUDA."""
    return package_version(package) or package_version(f"{package}-cpu")
