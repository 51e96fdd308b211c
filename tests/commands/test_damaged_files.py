"""Damaged files that commands read: one line, no traceback, no warning, whatever the libraries below them do."""

import io
import json
import os
import subprocess
import sys
import warnings
import zipfile
import zlib
from contextlib import suppress

import numpy as np
import pytest

from scanchain.errors import InputError
from scanchain.landmarks.files import read_landmark_data, read_mrclam
from scanchain.logs.formats.clouds import CloudFileError, read_npy
from scanchain.maps import open_saved_map
from scanchain.maps.files import write_ply
from scanchain.runs.judging import judge_run
from scanchain.sessions.elsewhere import import_map
from tests.support import made
from tests.support.naive_logs import office, write


@pytest.fixture(autouse=True)
def _no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)
        yield


def mutants(data, begin, end, count, seed=0):
    """Bytes of a part that are other ones: flipped, brackets and quotes, taken out."""
    random = np.random.default_rng(seed)
    for at in random.integers(begin, end, count).tolist():
        for other in (bytes([data[at] ^ 1 << int(random.integers(8))]), b"(", b"'", b"\n", b""):
            yield data[:at] + other + data[at + 1 :]


def array_file(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def test_an_array_with_a_damaged_header_is_called_so(tmp_path):
    path, data = tmp_path / "1.npy", array_file(np.ones((20, 3), "f4"))
    for damaged in mutants(data, 6, 128, 120):
        path.write_bytes(damaged)
        with suppress(CloudFileError), warnings.catch_warnings(action="ignore", category=UserWarning):
            read_npy(path)


def test_a_landmark_problem_with_a_damaged_header_is_called_so(tmp_path):
    path = tmp_path / "problem.npz"
    shapes = {"odom": (2, 2), "observations": (4, 4), "sigma_odom": (2, 2), "sigma_landmark": (2, 2)}
    for damaged in mutants(array_file(np.ones((4, 4))), 6, 128, 80):
        with zipfile.ZipFile(path, "w") as file:  # with the right CRC
            for name, shape in shapes.items():
                file.writestr(f"{name}.npy", damaged if name == "observations" else array_file(np.ones(shape)))
        with pytest.raises(InputError) as caught, warnings.catch_warnings(action="ignore", category=UserWarning):
            read_landmark_data(path)
            raise InputError("read")
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("time", ["1e300", "-1e12", "inf", "nan"])
def test_times_of_landmarks_that_no_clock_shows_are_refused(tmp_path, time):
    (tmp_path / "Barcodes.dat").write_text("6 63\n")
    (tmp_path / "Robot1_Odometry.dat").write_text(f"0.0 1 0\n{time} 1 0\n")
    with pytest.raises(InputError, match="row 2 is not finite, or reaches 9e"):
        read_mrclam(tmp_path, 1)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return made.run("office", tmp_path_factory.mktemp("run") / "run", log__end_s=4.0)


@pytest.mark.parametrize("name", ["loops.parquet", "steps.parquet"])
def test_a_run_whose_tables_are_damaged_is_refused_by_their_name(finished, call, name):
    path = finished / name
    data = path.read_bytes()
    try:
        for damaged in (b"", b"PAR1", data[: len(data) // 2], *mutants(data, 4, len(data), 12)):
            path.write_bytes(damaged)
            with suppress(InputError):
                judge_run(finished)
        path.write_bytes(data[:-9])
        code, _, errors = call("check", finished)
        assert code == 2 and f"has no {name} that can be read" in errors and "--debug" not in errors
    finally:
        path.write_bytes(data)


@pytest.mark.parametrize("data", [None, b"{"], ids=["absent", "damaged"])
def test_a_run_without_its_metrics_has_no_verdict_on_an_error_that_it_does_not_know(finished, call, data):
    path = finished / "metrics.json"
    before = path.read_bytes()
    try:
        path.unlink() if data is None else path.write_bytes(data)
        code, output, errors = call("check", finished)
        assert (code, output) == (2, "") and "metrics.json: cannot be read, but a verdict needs it" in errors
    finally:
        path.write_bytes(before)


SHAPES = [
    ("keyframes.npz", "session", lambda array: array[:-1]),
    ("keyframes.npz", "session", lambda array: array + 7),
    ("keyframes.npz", "session", lambda array: array[:, None]),
    ("keyframes.npz", "poses", lambda array: array * np.nan),
    ("keyframes.npz", "poses", lambda array: array.astype(complex)),
    ("keyframes.npz", "count", lambda array: array.astype(float)),
    ("keyframes.npz", "count", lambda array: -array + 2 * array.mean().astype(int)),
    ("keyframes.npz", "step_m", lambda array: array * np.inf),
    ("keyframes.npz", "stamps_ns", lambda array: array.astype(str)),
    ("edges.npz", "pairs", lambda array: array[:, :1]),
    ("edges.npz", "pairs", lambda array: array + 10**6),
    ("edges.npz", "pairs", lambda array: array.astype(float)),
    ("edges.npz", "measurements", lambda array: array[:, :2]),
    ("edges.npz", "information", lambda array: array[1:]),
    ("edges.npz", "is_loop", lambda array: array.astype(int)),
    ("edges.npz", "weight", lambda array: array[None]),
]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A map of a hall."""
    folder = tmp_path_factory.mktemp("map")
    random = np.random.default_rng(0)
    points = np.vstack([random.uniform(-12, 12, (9000, 3)) * [1, 1, 0], random.uniform(-12, 12, (9000, 3))])
    points[9000:, 0] = np.sign(points[9000:, 0]) * 12.0
    write_ply(folder / "m.ply", points)
    import_map(folder / "m.ply", folder / "map")
    return folder / "map" / "map"


@pytest.mark.parametrize(("name", "array", "change"), SHAPES)
def test_a_map_with_right_checksums_and_wrong_arrays_is_refused(place, name, array, change):
    path, index = place / name, place / "map.json"
    before = path.read_bytes(), index.read_bytes()
    assert open_saved_map(place).keyframes
    try:
        with np.load(path) as file:
            arrays = dict(file)
        if not len(arrays[array]):  # an imported map has no edges
            arrays = {"pairs": [[0, 1]], "measurements": [np.eye(4)], "information": [np.eye(6)]} | {
                "is_loop": [True], "weight": [1.0]
            }  # fmt: skip
        np.savez(path, **(arrays | {array: change(np.array(arrays[array]))}))
        stated = json.loads(before[1])
        stated["crc32"][name] = zlib.crc32(path.read_bytes())
        index.write_text(json.dumps(stated))
        with pytest.raises(InputError, match="make the map again"):
            open_saved_map(place)
    finally:
        path.write_bytes(before[0])
        index.write_bytes(before[1])


def test_a_name_that_is_no_text_is_refused_in_one_line(call, tmp_path):
    log = write(tmp_path / "a.mcap", office(3))
    odd = os.fsdecode(os.fsencode(tmp_path) + b"/run\xff")
    for words in (["run", log, "--out", odd], ["batch", log, "--out", odd], ["info", odd]):
        code, output, errors = call(*words)
        assert (code, output) == (2, "") and "run\\xff: the name is not UTF-8; rename it" in errors
        assert errors.count("\n") == 1


@pytest.mark.parametrize("closing", ["| head -0", ">&-", "2>&- | head -0"])
def test_nothing_is_said_where_nobody_reads_the_output(tmp_path, closing):
    log = write(tmp_path / "a.mcap", office(3))
    code = "import sys; from scanchain.entry import main; sys.exit(main())"
    shell = f'"{sys.executable}" -c "{code}" info "{log}" {closing}'
    done = subprocess.run(["bash", "-c", shell], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("", "")
