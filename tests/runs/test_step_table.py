"""The table of steps, in memory and in a file."""

from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq

from scanchain import lie
from scanchain.runs.evidence import evidence_of
from scanchain.runs.step_table import steps_table, write_table
from scanchain.steps import Steps
from tests.support.recordings import drive


def test_a_table_holds_the_figures_of_the_steps(tmp_path):
    table = Steps()
    steps = [
        replace(step, reason=f"a new map begins {step.scan.index % 3}", starts_segment=step.scan.index == 7)
        for step in drive(20, 2)
    ]
    T_odom_base = lie.pose_2d(1.0, 2.0, 0.3)
    steps[9] = replace(steps[9], scan=replace(steps[9].scan, T_odom_base=T_odom_base))
    for step in steps:
        table.append(step)
    columns = table.columns
    assert len(table) == 20 and columns["has_wheels"].tolist() == [k == 9 for k in range(20)]
    np.testing.assert_array_equal(columns["T_odom_base"][9], T_odom_base)
    np.testing.assert_array_equal(columns["information"], [step.match.information for step in steps])
    np.testing.assert_array_equal(columns["timing"][:, 2], [step.timing.match_s for step in steps])
    write_table(tmp_path / "steps.parquet", steps_table(table, table.trajectory("T_world_lidar")))
    written = pq.ParquetFile(tmp_path / "steps.parquet").read()
    assert written["reason"].to_pylist() == [step.reason for step in steps]
    found = evidence_of(written, None)
    assert np.flatnonzero(found.starts_segment).tolist() == [7]
