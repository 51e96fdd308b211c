"""A log format of the user's own: a class named as module:Class, found in the working directory."""

import json
import os
import sys

import numpy as np
import pytest

from scanchain.__main__ import main
from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log

FORMAT = '''
import numpy as np

class Clouds:
    """An array of clouds, ten a second."""

    def __init__(self, path):
        self.path = path

    def scans(self):
        for k, points in enumerate(np.load(self.path)):
            yield 1000 + 0.1 * k, points, np.linspace(0.0, 0.09, len(points))
'''


@pytest.fixture
def own(tmp_path, monkeypatch, request):
    """A folder, which is the working directory, with a module of its own; its import is forgotten."""
    monkeypatch.chdir(tmp_path)
    name = f"own_{abs(hash(request.node.nodeid))}"
    path = list(sys.path)
    (tmp_path / f"{name}.py").write_text(FORMAT)
    yield f"{name}:Clouds"
    sys.path[:] = path
    sys.modules.pop(name, None)


def write_clouds(path, clouds):
    with path.open("wb") as file:
        np.save(file, clouds)
    return path


def clouds_of(count, planar=False):
    """Points (900, 3) or (900, 2) on the walls of a room around a lidar that moves 0.05 m along x a scan."""
    rng = np.random.default_rng(1)
    low, high = np.array([-4, -3, -1.0]), np.array([4, 3, 2.0])
    clouds = []
    for k in range(count):
        points, axis = rng.uniform(low, high, (900, 3)), rng.integers(2 if planar else 3, size=900)
        points[np.arange(900), axis] = np.where(rng.random(900) < 0.5, low[axis], high[axis])
        clouds.append((points - [0.05 * k, 0.0, 0.0])[:, : 2 if planar else 3])
    return clouds


@pytest.mark.parametrize("planar", [False, True])
def test_scans_arrive_as_they_were_yielded_those_of_the_plane_as_a_2d_log(own, tmp_path, planar):
    clouds = clouds_of(4, planar)
    log = open_log(write_clouds(tmp_path / "drive.dat", clouds), LogConfig(format=own))
    scans = list(log.scans())
    assert (log.dimension, log.scan_count, log.topic) == (2 if planar else 3, 4, "/points")
    assert [scan.stamp_ns for scan in scans] == [1_000_000_000_000 + 100_000_000 * k for k in range(4)]
    for scan, cloud in zip(scans, clouds, strict=True):
        np.testing.assert_allclose(scan.points, cloud, atol=1e-6)
        np.testing.assert_allclose(scan.times_s, np.linspace(0.0, 0.09, len(cloud)), atol=1e-6)
    assert [str(path) for path in log.paths] == [str(tmp_path / "drive.dat")]
    assert f"{tmp_path / 'drive.dat'}: 4 scans read by {own} (log.format)" in log.notes


def test_a_folder_is_given_to_the_class_as_it_is(own, tmp_path):
    (tmp_path / "parts").mkdir()
    write_clouds(tmp_path / "parts" / "a.mcap", clouds_of(3))  # a name by which folders are otherwise split
    module = tmp_path / f"{own.partition(':')[0]}.py"
    module.write_text(FORMAT.replace("self.path = path", 'self.path = path / "a.mcap"'))
    assert open_log(tmp_path / "parts", LogConfig(format=own)).scan_count == 3


def test_run_info_and_convert_take_the_flag(own, tmp_path, capsys):
    path = write_clouds(tmp_path / "drive.dat", clouds_of(12))
    assert main(["info", str(path), "--log.format", own, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["lidar"], told["scans"], told["problem"]) == ("/points", 12, "")
    assert main(["convert", str(path), str(tmp_path / "drive.mcap"), "--log.format", own]) == 0
    assert open_log(tmp_path / "drive.mcap").scan_count == 12
    out = tmp_path / "run"
    assert main(["run", str(path), "--log.format", own, "--out", str(out), "--rerun", "off", "--no-loops"]) == 0
    rows = np.loadtxt(out / "trajectory.tum")
    assert len(rows) == 12
    assert rows[-1, 1] - rows[0, 1] == pytest.approx(0.55, abs=0.05)


@pytest.mark.parametrize(
    ("body", "complaint"),
    [
        ("yield 1.0, [[1, 2]]", r"scan 0 of own_\d+:Clouds is a tuple|scan 0 .*wanted a tuple \(stamp_s"),
        ("yield 1e18, [[1, 2, 3]], None", r"stamp_s is 1e\+18; wanted seconds"),
        ("yield 1.0, [1, 2, 3], None", r"scan 0 .*: points has the shape \(3,\)"),
        ("yield 1.0, [[1, 2, 3]], [1, 2]", r"times_s has the shape \(2,\); wanted \(1,\)"),
        (
            "yield 1.0, [[1, 2, 3]], None; yield 1.1, [[1, 2]], None",
            r"scan 1 .* points are not \(N, 3\)",
        ),
        (
            "yield 1.0, [[1, 2, 3]], None; 1 / 0",
            r"scan 1 .*ZeroDivisionError: division by zero \(File .*own_\d+\.py\", line",
        ),
        ("return iter(())", "yields no scan; check"),
    ],
)
def test_what_is_no_scan_is_refused_with_its_place(own, tmp_path, body, complaint):
    (tmp_path / f"{own.partition(':')[0]}.py").write_text(
        f"class Clouds:\n    def __init__(self, path): ...\n    def scans(self):\n        {body}\n"
    )
    path = write_clouds(tmp_path / "drive.dat", clouds_of(1))
    with pytest.raises(InputError, match=complaint) as error:
        open_log(path, LogConfig(format=own))
    assert str(path) in str(error.value)


def test_a_class_without_scans_or_of_no_module_is_refused(own, tmp_path):
    (tmp_path / f"{own.partition(':')[0]}.py").write_text("class Clouds: ...\n")
    for name, complaint in (
        (own, "has no method scans"),
        ("nowhere:Class", "no module nowhere"),
        ("mcab", "wanted auto, mcap, .* or module:Class"),
        ("carmen", "text without a line of FLASER"),  # a known format can be named
    ):
        with pytest.raises(InputError, match=complaint):
            open_log(write_clouds(tmp_path / "drive.dat", clouds_of(1)), LogConfig(format=name))


def test_nothing_is_left_behind(own, tmp_path, monkeypatch):
    spare = tmp_path / "spare"
    spare.mkdir()
    monkeypatch.setattr("tempfile.tempdir", os.fspath(spare))
    log = open_log(write_clouds(tmp_path / "drive.dat", clouds_of(2)), LogConfig(format=own))
    assert not list(spare.iterdir())
    assert len(list(log.scans())) == 2
