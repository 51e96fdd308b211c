"""Logs and runs that tests share."""

from tests.support import made


def test_a_log_is_made_once_and_a_test_may_damage_its_copy(tmp_path):
    mine = made.log("office", tmp_path, seconds=1)
    shared = made.log("office", seconds=1.0)
    assert mine == tmp_path / "office.mcap" and mine.read_bytes() == shared.read_bytes()
    assert mine.with_suffix(".tum").exists()
    made_ns = shared.stat().st_mtime_ns
    mine.write_bytes(b"")
    assert made.log("office", seconds=1).stat().st_mtime_ns == made_ns and shared.stat().st_size > 0
    assert made.log("office", seconds=1, seed=1).read_bytes() != shared.read_bytes()


def test_a_run_is_made_once_and_a_test_may_damage_its_copy(tmp_path):
    mine, shared = made.run("office", tmp_path, seconds=1), made.run("office", seconds=1)
    assert mine == tmp_path / "office" and (mine / "map").is_dir()
    (mine / "trajectory.tum").write_text("")
    assert (shared / "trajectory.tum").stat().st_size > 0 and made.run("office", seconds=1) == shared
