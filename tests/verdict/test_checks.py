"""The table of checks: every check of the package, and any that is added."""

import numpy as np

from scanchain.verdict import CHECKS, Check, Verdict, judge
from scanchain_viz.colors import color_of_kind
from tests.support.courses import POSES, evidence, marked


class Heights(Check):
    """A check of an altimeter, as one would be added: poses of the lidar by another sensor."""

    name, kind, column, source, limit = "heights", "heights disagree", "height_innovation", "height", 3.0

    def __init__(self, evidence):
        off_m = evidence.poses[:, 1, -1] - evidence.sources[self.source][:, 1, -1]
        self.values = np.abs(off_m) / 0.1


def test_a_new_check_is_a_class_and_a_line_of_the_table(monkeypatch):
    monkeypatch.setattr("scanchain.verdict.judging.CHECKS", (*CHECKS, Heights))
    assert "heights" in judge(evidence(sources={"height": POSES})).reason
    off = POSES + marked(300, 330)[:, None, None] * np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    judged = judge(evidence(sources={"height": off}))
    assert (
        judged.verdict is Verdict.CHECK and judged.reason == "scans 300 to 330 (60.0 to 66.0 s): heights disagree"
    )
    assert color_of_kind(judged.segments[0].kind) == color_of_kind("another kind of one's own")


def test_every_check_of_the_package_is_in_the_table_once_with_a_column_of_its_own():
    own = [check for check in Check.__subclasses__() if check.__module__.startswith("scanchain.")]
    assert sorted(CHECKS, key=repr) == sorted(own, key=repr)
    columns = [check.column for check in CHECKS if check.column]
    assert len(set(columns)) == len(columns) >= 3
