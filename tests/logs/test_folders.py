"""Folders of sweeps: KITTI raw and odometry, PCD and PLY as open3d writes them, raw float32."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.baselines import Open3dPairs
from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.logs.formats.clouds import stamp_of_name
from scanchain.simulation import simulate
from tests.support import recorders
from tests.support.recorders import SECOND, STAMP_NS, assert_clouds, read
from tests.support.sensor_files import PCD, PLY, camera, kitti_odometry, kitti_raw, xyzi

PCD_HEAD = """VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 64
HEIGHT 1
VIEWPOINT {viewpoint}
POINTS 64
DATA ascii
"""


def assert_points(scans, said):
    for scan, cloud in zip(scans, said, strict=True):
        np.testing.assert_array_equal(scan.points, xyzi(cloud)[:, :3])


# KITTI


def test_a_kitti_drive_has_its_sweeps_their_times_and_as_truth_its_gps_moved_to_the_lidar(tmp_path):
    said = recorders.clouds()
    log, scans = read(kitti_raw(tmp_path, said))
    assert (log.dimension, log.topic, log.scan_count) == (3, "/velodyne_points", 3)
    assert_points(scans, said)
    assert [scan.stamp_ns - 1_317_042_145 * SECOND for scan in scans] == [594_360, 1_594_360, 2_594_360]
    meter = np.pi / 180 * 6378137.0 * np.cos(np.radians(49.0))
    imu = np.tile(np.eye(4), (3, 1, 1))
    for k in range(3):
        roll, pitch, yaw = (lie.exp(np.array([0, 0, 0, *axis])) for axis in np.diag([0.01, -0.02, 0.3 * k]))
        imu[k] = yaw @ pitch @ roll
        imu[k, :3, 3] = 2e-5 * k * meter, 1e-5 * k / np.cos(np.radians(49.0)) * meter, 0.5 * k
    T_lidar_imu = np.array([[0, -1, 0, -0.8], [1, 0, 0, 0.3], [0, 0, 1, -0.75], [0, 0, 0, 1.0]])
    expected = imu @ np.linalg.inv(T_lidar_imu)
    np.testing.assert_allclose(log.ground_truth().poses, np.linalg.inv(expected[0]) @ expected, atol=2e-6)


def test_a_kitti_drive_without_its_calibration_has_no_truth_and_says_so(tmp_path):
    log, scans = read(kitti_raw(tmp_path, recorders.clouds(), calibrated=False))
    assert len(scans) == 3 and log.ground_truth() is None
    assert "calib_imu_to_velo.txt: is absent" in " ".join(log.notes)


@pytest.mark.parametrize("number", ["-inf", "nan", "1e203", "x", ""])
def test_a_calibration_that_is_no_motion_leaves_no_truth_and_one_line_of_damage(tmp_path, number):
    drive, sequence = kitti_raw(tmp_path, recorders.clouds()), kitti_odometry(tmp_path, recorders.clouds())
    for file, line in ((tmp_path / "calib_imu_to_velo.txt", "R: 0 -1"), (sequence / "calib.txt", "Tr: 0 -1")):
        file.write_text(file.read_text().replace(line, f"{line[:-4]}{number} -1"))
    for path, name in ((drive, "R"), (sequence, "Tr")):
        log, scans = read(path)
        assert len(scans) == 3 and log.ground_truth() is None
        line, recovered = log.damage
        assert (
            "3 scans" in recovered
            and f" line {name}: " in line
            and "download it again; there is no ground truth until then" in line
        )


def test_sweeps_that_are_absent_or_cut_off_leave_the_times_of_the_others(tmp_path):
    said = recorders.clouds(4)
    drive = kitti_raw(tmp_path, said)
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    with (drive / "velodyne_points/data/0000000002.bin").open("ab") as file:
        file.write(b"xyz")
    log, scans = read(drive)
    assert_points(scans, [said[0], said[3]])
    assert scans[1].stamp_ns - scans[0].stamp_ns == 3_000_000
    assert "0000000002.bin" in log.damage[0] and "multiple of" in log.damage[0]


def test_a_kitti_odometry_sequence_begins_at_time_zero_and_knows_its_truth(tmp_path):
    said = recorders.clouds(5)
    log, scans = read(kitti_odometry(tmp_path, said))
    assert_points(scans, said)
    assert [scan.stamp_ns for scan in scans] == [round(0.103736e9 * k) for k in range(5)]
    assert log.duration_s == pytest.approx(0.414944)
    T_camera_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    truth = log.ground_truth()
    assert truth is not None and len(truth) == 5
    for k in range(5):
        expected = np.linalg.inv(T_camera_lidar) @ camera(k) @ T_camera_lidar
        np.testing.assert_allclose(truth.poses[k], expected, atol=1e-9)


def test_a_kitti_folder_whose_parts_do_not_fit_says_so(tmp_path):
    sequence = kitti_odometry(tmp_path, recorders.clouds())
    (sequence / "times.txt").write_text("0.0\n")
    with pytest.raises(InputError, match="does not fit the 1 timestamp;"):
        read(sequence)
    (sequence / "times.txt").write_text("noon\n")
    with pytest.raises(InputError, match=r"times\.txt: is not a table of 1 numbers"):
        read(sequence)


# PCD and PLY


@pytest.mark.parametrize("suffix", ["pcd", "ply"])
@pytest.mark.parametrize("options", [{"write_ascii": True}, {}, {"compressed": True}], ids=str)
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_clouds_that_open3d_writes_are_read_to_the_last_bit(tmp_path, suffix, options, kind):
    module, said = Open3dPairs("point-to-point").open3d, recorders.clouds()
    for cloud in said:
        positions = np.column_stack([cloud.rows[name] for name in "xyz"]).astype(kind)
        saved = module.t.geometry.PointCloud(module.core.Tensor(positions))
        saved.point["intensity"] = module.core.Tensor(cloud.rows["t"].astype(np.float32)[:, None])
        assert module.t.io.write_point_cloud(str(tmp_path / f"{cloud.stamp_ns}.{suffix}"), saved, **options)
    log, scans = read(tmp_path)
    assert (log.dimension, log.topic, log.scan_count, log.damage) == (3, "/points", 3, [])
    if options.get("write_ascii"):
        for scan, cloud in zip(scans, said, strict=True):
            np.testing.assert_allclose(scan.points, xyzi(cloud)[:, :3], rtol=1e-4)  # as many digits as it writes
            assert scan.stamp_ns == cloud.stamp_ns
    else:
        assert_clouds(scans, said, timed=False)


def test_the_times_in_a_pcd_are_those_of_its_points(tmp_path):
    dtype = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<u8"), ("ring", "<u2")]
    rows = np.zeros(11, dtype)
    rows["x"], rows["timestamp"] = np.arange(1, 12), STAMP_NS + np.arange(11) * 10_000_000
    content = PCD.format(count=11, form="binary").encode() + rows.tobytes()
    (tmp_path / f"cloud_{STAMP_NS // SECOND}_000000000.pcd").write_bytes(content)
    _, (scan,) = read(tmp_path)
    np.testing.assert_array_equal(scan.points[:, 0], np.arange(1, 12))
    np.testing.assert_allclose(scan.times_s, np.arange(11) * 0.01, atol=1e-6)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_a_ply_may_be_in_any_byte_order_with_other_fields_and_elements(tmp_path, form):
    order = ">" if "big" in form else "<"
    rows = np.zeros(4, [("x", order + "f8"), ("y", order + "f4"), ("z", order + "f4"), ("ring", "u1")])
    rows["x"], rows["y"], rows["ring"] = [1, 2, 3, 4], [0.5, 1.5, 2.5, 3.5], [9, 8, 7, 6]
    rows["z"] = [4, 3, 2, 1]
    body = rows.tobytes() + b"\x03" + bytes(12)
    if form == "ascii":
        body = b"".join(b" ".join(str(value).encode() for value in row) + b"\n" for row in rows) + b"3 0 1 2\n"
    (tmp_path / "1.5.ply").write_bytes(PLY.format(form=form, count=4).encode() + body)
    _, (scan,) = read(tmp_path)
    np.testing.assert_array_equal(scan.points, np.column_stack([rows["x"], rows["y"], rows["z"]]))
    assert scan.stamp_ns == 1_500_000_000


@pytest.mark.parametrize(
    ("stem", "stamp_ns"),
    [
        ("1700000000123456789", 1_700_000_000_123_456_789),
        ("1700000000123456", 1_700_000_000_123_456_000),
        ("1700000000123", 1_700_000_000_123_000_000),
        ("scan-1700000000.25", 1_700_000_000_250_000_000),
        ("12.375", 12_375_000_000),
        ("cloud_1583836591_182590976", 1_583_836_591_182_590_976),
        ("cloud_1583836591_82590976", 1_583_836_591_082_590_976),
        ("2011-09-26_14-14-10.103600128", 1_317_046_450_103_600_128),
        ("20110926_141410_250", 1_317_046_450_250_000_000),
        ("lidar_2011-09-26T14:14:10Z", 1_317_046_450_000_000_000),
        ("2011-26-09_14-14-10.5", None),
        ("14-14-10.5", None),
        ("000017", None),
        ("0000000017", None),
        ("0000000000000000017", None),
        ("map", None),
    ],
)
def test_a_name_tells_its_stamp_or_none(stem, stamp_ns):
    assert stamp_of_name(stem) == stamp_ns


@pytest.mark.parametrize(
    ("names", "steps_ns"),
    [
        (["1583836591_900", "1583836592_000", "1583836592_100"], 100_000_000),
        (["1583836591_900000", "1583836592_0", "1583836592_100000"], 100_000_000),
        (["1583836591_999999995", "1583836592_0", "1583836592_5"], 5),
    ],
    ids=["milliseconds", "microseconds", "nanoseconds"],
)
def test_seconds_and_their_fraction_in_names_have_the_unit_of_the_longest(tmp_path, names, steps_ns):
    for name, cloud in zip(names, recorders.clouds(3), strict=True):
        xyzi(cloud).tofile(tmp_path / f"{name}.bin")
    _, scans = read(tmp_path)
    assert np.diff([scan.stamp_ns for scan in scans]).tolist() == [steps_ns, steps_ns]


def test_stamps_are_found_before_both_suffixes_of_nuscenes(tmp_path):
    for k, cloud in enumerate(recorders.clouds(3)):
        xyzi(cloud).tofile(tmp_path / f"n015__LIDAR_TOP__153240292764{k}951.pcd.bin")
    _, scans = read(tmp_path)
    assert [scan.stamp_ns for scan in scans] == [1_532_402_927_640_951_000 + 1_000_000 * k for k in range(3)]


def test_files_that_are_only_numbered_need_a_rate(tmp_path):
    said = recorders.clouds(12)
    for k, cloud in enumerate(said):
        xyzi(cloud).tofile(tmp_path / f"scan{k}.bin")
    with pytest.raises(InputError, match=r"scan0\.bin contain no stamp.*log__rate_hz 10"):
        read(tmp_path)
    log, scans = read(tmp_path, rate_hz=20.0)
    assert_points(scans, said)  # scan2 comes before scan10
    assert [scan.stamp_ns for scan in scans] == [50_000_000 * k for k in range(12)]
    assert log.scan_count == 12 and log.duration_s == pytest.approx(0.55)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("1.0.pcd", b""),
        ("1.0.pcd", b"\0" * 500),
        ("1.0.pcd", PCD.format(count=1000, form="binary").encode()),
        ("1.0.pcd", PCD.format(count=1000, form="binary_compressed").encode() + b"\xff" * 9),
        ("1.0.pcd", PCD.format(count=-1, form="binary").encode() + bytes(500)),
        ("1.0.pcd", PCD.format(count=3, form="ascii").encode() + b"1 2\n"),
        ("1.0.pcd", PCD.replace("x y z", "a b c").format(count=0, form="ascii").encode()),
        ("1.0.ply", b""),
        ("1.0.ply", b"ply\n" + b"comment\n" * 5000),
        ("1.0.ply", PLY.format(form="binary_little_endian", count=10**9).encode()),
        ("1.0.ply", PLY.format(form="ascii", count=3).encode() + b"1 2\n"),
        ("1.0.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n"),
    ],
)
def test_a_file_that_is_broken_is_left_out_and_told(tmp_path, name, content):
    good = PLY if name.endswith("ply") else PCD
    rows = np.ones(1, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<u8"), ("ring", "<u2")])
    if good is PLY:
        rows = np.ones(1, [("x", "<f8"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1")])
    form = "binary_little_endian" if good is PLY else "binary"
    (tmp_path / f"2.0{name[3:]}").write_bytes(good.format(form=form, count=1).encode() + rows.tobytes())
    (tmp_path / name).write_bytes(content)
    log, scans = read(tmp_path)
    assert [scan.stamp_ns for scan in scans] == [2 * SECOND]
    assert name in log.damage[0] and "skipped" in log.damage[0]
    assert f"is malformed: {name} " in log.damage[1]


def test_a_run_directory_is_no_log(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / "map.ply").write_text("")
    with pytest.raises(InputError, match=r"is a run directory, not a log; give the log named in its run\.json"):
        open_log(tmp_path)


def swept(k, count=300):
    """Points (N, 6) as a lidar sees them, flat and wide, with intensity, ring and time."""
    rng = np.random.default_rng(k)
    columns = [rng.normal(0.0, 20.0, count), rng.normal(0.0, 20.0, count), rng.normal(-1.0, 0.7, count)]
    return np.column_stack([*columns, rng.uniform(0, 1, count), rng.integers(0, 32, count), np.zeros(count)])


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
@pytest.mark.parametrize(("suffix", "kind"), [(".npy", "float32"), (".npy", "float64"), (".bin", "float32")])
def test_folders_of_arrays_open_whatever_their_columns_and_say_what_was_found(tmp_path, suffix, columns, kind):
    clouds = [swept(k, 251 + 34 * k)[:, :columns].astype(kind) for k in range(6)]
    for k, cloud in enumerate(clouds):
        if suffix == ".npy":
            np.save(tmp_path / f"{k}.npy", cloud)
        else:
            cloud.tofile(tmp_path / f"{k}.bin")
    if suffix == ".bin" and columns != 4:
        with pytest.raises(InputError, match=r"no multiple of 4 float32 numbers; .*log__bin_columns 5, or save"):
            read(tmp_path, rate_hz=10.0)
    log, scans = read(tmp_path, rate_hz=10.0, bin_columns=columns)
    for scan, cloud in zip(scans, clouds, strict=True):
        np.testing.assert_array_equal(scan.points, cloud[:, :3].astype(np.float32))
    names = " ".join(["x", "y", "z", "intensity", "column_5", "column_6"][:columns])
    assert f"6 {suffix} files of {names}, {kind}" in log.notes[0]
    assert f"{len(clouds[0])} points in 0{suffix}" in log.notes[0]


@pytest.mark.parametrize("columns", [3, 4, 5, 6])
def test_columns_of_a_bin_file_that_are_those_of_another_number_are_a_warning_with_the_flag(tmp_path, columns):
    swept(0, 240)[:, :columns].astype("f4").tofile(tmp_path / "0.bin")  # the bytes are a multiple of all
    for stated in (4, columns):
        log, _ = read(tmp_path, rate_hz=10.0, bin_columns=stated)
        assert (f"set --log.bin_columns {columns}" in str(log.damage)) == (stated != columns)


@pytest.mark.parametrize("change", [np.transpose, lambda rows: rows.astype("f8")], ids=["by columns", "float64"])
def test_a_bin_file_that_has_no_rows_of_float32_is_a_warning(tmp_path, change):
    change(swept(0, 240)[:, :4].astype("f4")).copy(order="C").tofile(tmp_path / "0.bin")
    log, _ = read(tmp_path, rate_hz=10.0)
    assert "its numbers are no rows of float32" in str(log.damage)


@pytest.mark.parametrize("kind", ["float16", "int32", "int64", ">f4", ">f8"])
def test_arrays_of_any_number_type_and_with_named_fields_are_read(tmp_path, kind):
    cloud = np.rint(swept(1)[:, :3]).astype(kind)
    np.save(tmp_path / "1.0.npy", cloud)
    named = np.rec.fromarrays(list(cloud.T[::-1]), names="z,y,x")
    np.save(tmp_path / "2.0.npy", named)
    np.save(tmp_path / "3.0.npy", np.asfortranarray(cloud))
    scans = read(tmp_path)[1]
    assert len(scans) == 3
    for scan in scans:
        np.testing.assert_array_equal(scan.points, cloud[np.any(cloud, axis=1)].astype(np.float32))


@pytest.mark.parametrize(
    ("array", "said"),
    [
        (np.ones((3, 900)), "is an array (3, 900) of float64; give numbers (N, 3), (N, 4)"),
        (np.ones(900), "is an array (900,) of float64"),
        (np.array([[{}, 1, 2]]), "is not a .npy array of numbers"),
    ],
)
def test_arrays_that_are_no_clouds_are_left_out_told_by_the_first_and_their_number(tmp_path, array, said):
    for k in range(30):
        np.save(tmp_path / f"{k:02}.npy", array, allow_pickle=True)
    np.save(tmp_path / "30.npy", swept(0))
    log = open_log(tmp_path, LogConfig(rate_hz=10.0, max_bad_scans_percent=100.0))
    assert len(list(log.scans())) == 1 and said in log.damage[0]
    assert len(log.damage) < 6 and any("02.npy" in line and "27 more like this" in line for line in log.damage)


def test_a_folder_of_several_kinds_of_clouds_says_which_it_left_out(tmp_path):
    np.save(tmp_path / "1.0.npy", swept(0))
    np.save(tmp_path / "2.0.npy", swept(1))
    assert not any("files are read" in note for note in open_log(tmp_path).notes)
    (tmp_path / "1.5.pcd").write_text(PCD.format(count=3, form="ascii") + "1 2 3\n" * 3)
    (note,) = [note for note in open_log(tmp_path).notes if "files are read" in note]
    assert note.startswith(f"{tmp_path}: only its .pcd files are read, not 2 .npy;")
    simulate("office", tmp_path / "part.mcap", duration_s=1.0)
    (note,) = [note for note in open_log(tmp_path).notes if "files are read" in note]
    assert note.startswith(f"{tmp_path}: only its .mcap files are read, not 1 .pcd, 2 .npy;")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("file", ["times.txt", "../../poses/07.txt"])
@pytest.mark.parametrize("number", ["1e308", "-1e308", "inf", "nan"])
def test_numbers_of_kitti_beyond_all_measure_are_damage_and_no_warnings_of_numpy(tmp_path, file, number):
    sequence = kitti_odometry(tmp_path, recorders.clouds())
    lines = (sequence / file).read_text().splitlines()
    (sequence / file).write_text("\n".join([*lines[:-1], " ".join([number] * len(lines[0].split()))]) + "\n")
    try:
        damage = read(sequence)[0].damage[0]
    except InputError as error:
        damage = str(error)
    assert "contains numbers that are not finite or too large" in damage


def test_a_pose_in_a_pcd_file_that_is_not_used_is_told(tmp_path):
    for k, viewpoint in enumerate(["0 0 0 1 0 0 0", "0.0 0 0 1.0 0 0 0", "1 2 0 1 0 0 0"]):
        xyz = "\n".join(f"{i} {j} {i % 3}" for i in range(1, 9) for j in range(1, 9))
        head = PCD_HEAD.format(viewpoint=viewpoint)
        (tmp_path / f"{k + 1}.0.pcd").write_text(f"{head}{xyz}\n")
        log, _ = read(tmp_path)
        assert ("its VIEWPOINT is not used" in str(log.notes)) == (k == 2)
