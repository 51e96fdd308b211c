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
    assert not [name for name in written.column_names if name.startswith("innovation_")]
    found = evidence_of(written, None)
    assert np.flatnonzero(found.starts_segment).tolist() == [7]


def test_innovations_have_columns_for_the_sensors_that_were_compared_and_fixes_are_at_the_nearest_scan():
    table, steps = Steps(), drive(20, 2)
    for step in steps:
        values = {"gyro": float(step.scan.index) if step.scan.index % 2 else np.nan, "wheels": np.nan}
        table.append(replace(step, scan=replace(step.scan, stamp_ns=10**8 * step.scan.index), innovations=values))
    table.compare("GNSS", 10**7 * np.array([1, 46, 54, 190, 195]), np.array([0.5, 1.0, 2.0, 3.0, 4.0]))
    written = steps_table(table, table.trajectory("T_world_lidar"))
    assert [name for name in written.column_names if "innovation_" in name] == [
        "innovation_gyro",
        "innovation_gnss",
    ]
    assert written["innovation_gyro"].to_pylist() == [float(k) if k % 2 else None for k in range(20)]
    fixes = {0: 0.5, 5: 2.0, 19: 4.0}
    assert written["innovation_gnss"].to_pylist() == [fixes.get(k) for k in range(20)]
