"""What a comparison found, and its files beside the table."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import tomli_w

from scanchain.comparison.judging import Judged, judge, representative
from scanchain.comparison.maps import picture_points
from scanchain.comparison.methods import Method
from scanchain.comparison.outcome import CLOSURES_FILE, STEPS_FILE, Outcome
from scanchain.comparison.scan_store import StoredScans
from scanchain.comparison.scan_table import RunOfMethod, write_relations, write_scans
from scanchain.data import Points, Trajectory
from scanchain.evaluation import Relations, during
from scanchain.maps import write_ply
from scanchain.trajectory import write_tum

SCANS_FILE, RELATIONS_FILE = "per_scan.parquet", "per_relation.parquet"
SETTINGS_FILE, TRUTH_FILE = "settings.toml", "ground_truth.tum"
METHODS_FOLDER, MAP_FILE, TRAJECTORY_FILE = "methods", "map.ply", "trajectory.tum"


@dataclass(frozen=True, slots=True)
class Reference:
    """What errors are against: poses, relations, both or nothing; ``note`` says what is missing."""

    truth: Trajectory | None
    relations: Relations | None
    source: str
    note: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """All runs of all methods by name, what was found of each, and the map (M, d) of each that came to its end."""

    methods: Sequence[Method]
    scans: StoredScans
    outcomes: Mapping[str, list[Outcome]]
    judged: Mapping[str, Judged]
    maps: Mapping[str, Points]
    reference: Reference


def write_evidence(folder: Path, evidence: Evidence) -> None:
    """Everything scan by scan, and a folder a method with trajectory, map, tables, and what it printed."""
    write_scans(folder / SCANS_FILE, list(_runs(evidence)), evidence.scans.stamps_ns)
    write_relations(folder / RELATIONS_FILE, evidence.judged)
    if evidence.reference.truth is not None:
        write_tum(folder / TRUTH_FILE, during(evidence.reference.truth, evidence.scans.stamps_ns))
    settings = {method.name: {"method": method.base} | method.settings for method in evidence.methods}
    (folder / SETTINGS_FILE).write_text(tomli_w.dumps(settings), encoding="utf-8")
    for method in evidence.methods:
        _write_method(method_folder(folder, method.name), evidence, method.name)


def _runs(evidence: Evidence) -> Iterator[RunOfMethod]:
    """Every run, judged by itself."""
    stamps_ns, truth = evidence.scans.stamps_ns, evidence.reference.truth
    for name, outcomes in evidence.outcomes.items():
        for repeat, outcome in enumerate(outcomes):
            stands_for_all = outcome is representative(outcomes)
            judged = evidence.judged[name] if stands_for_all else judge([outcome], stamps_ns, truth, None)
            yield RunOfMethod(name, repeat, outcome, judged)


def method_folder(folder: Path, name: str) -> Path:
    """Where the files of a method lie."""
    return folder / METHODS_FOLDER / quote(name, safe="+ ")


def _write_method(own: Path, evidence: Evidence, name: str) -> None:
    outcome, judged = representative(evidence.outcomes[name]), evidence.judged[name]
    own.mkdir(parents=True)
    if outcome.is_whole:
        write_tum(own / TRAJECTORY_FILE, outcome.trajectory)
    if name in evidence.maps:
        write_ply(own / MAP_FILE, picture_points(evidence.maps[name], judged))
    for file in (STEPS_FILE, CLOSURES_FILE, "output.txt"):
        source = outcome.folder / file
        if source.exists() and source.stat().st_size:
            shutil.copy(source, own / file)
