"""A simulated kidnapping, judged as the benchmark of the verdict does it."""

from tests.benchmarks import vouching
from tests.benchmarks.vouching_logs import Case, LogSpec


def test_a_kidnapping_is_wrong_and_flagged_and_the_rest_right(tmp_path, capsys):
    log = LogSpec("office", "lms-270", "kidnapped", duration_s=8.0, dimension=2)
    case = Case(log, "no wheels")
    (row,) = vouching.measured([case], tmp_path)
    counts = row["counts"]
    assert (counts["wrong flagged"] >= 5, counts["wrong silent"]) == (True, 0)
    assert counts["right ok"] >= 40 and row["verdict"] != "trustworthy"
    (again,) = vouching.measured([case], tmp_path)
    assert again == row
    vouching.table([row])
    assert f"| 2D kidnapped | 1 | {counts['wrong flagged']} of" in capsys.readouterr().out
