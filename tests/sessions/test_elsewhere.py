import json
import struct
import sys

import numpy as np
import pytest
from PIL import Image

from scanchain.__main__ import main
from scanchain.data import Scan
from scanchain.errors import InputError
from scanchain.maps import open_saved_map, write_laz, write_pcd, write_ply
from scanchain.sessions.elsewhere import import_map
from scanchain.sessions.localizer import Localizer
from tests.support import made
from tests.support.messages import unfolded
from tests.support.scenes import shared_data


def hall(step_m: float = 0.2):
    """Points of the floor and the walls of a hall of 20 x 12 m, 4 m high."""
    x, y, z = np.arange(0.0, 20.0, step_m), np.arange(0.0, 12.0, step_m), np.arange(0.0, 4.0, step_m)

    def plane(u, v, *columns):
        a, b = (axis.ravel() for axis in np.meshgrid(u, v))
        parts = {"u": a, "v": b}
        return np.column_stack([parts.get(column, np.full(len(a), column)) for column in columns])

    walls = [plane(y, z, 0.0, "u", "v"), plane(y, z, 20.0, "u", "v"), plane(x, z, "u", 0.0, "v")]
    return np.vstack([plane(x, y, "u", "v", 0.0), *walls, plane(x, z, "u", 12.0, "v")])


@pytest.mark.parametrize(("name", "write"), [("m.ply", write_ply), ("m.pcd", write_pcd), ("m.laz", write_laz)])
def test_a_cloud_becomes_a_map_seen_from_above_its_ground(tmp_path, name, write):
    points = hall()
    write(tmp_path / name, points)
    made = import_map(tmp_path / name, tmp_path / "site", spacing_m=4.0)
    found = open_saved_map(tmp_path / "site")
    assert (made.dimension, made.points, made.keyframes) == (3, len(points), len(found.keyframes))
    assert made.keyframes >= 9
    assert [session.name for session in found.sessions] == [name]
    np.testing.assert_allclose(found.poses[:, 2, 3], 1.6, atol=0.01)
    for keyframe, pose in zip(found.keyframes, found.poses, strict=True):
        in_map = keyframe.points + pose[:3, 3]
        assert len(in_map) > 100
        assert np.linalg.norm(points[:, None] - in_map[::50], axis=2).min(axis=0).max() < 0.01


def grid_files(folder, cells, **changes):
    stated = {"image": "map.pgm", "resolution": 0.1, "origin": [1.0, 2.0, 0.0], "negate": 0} | {
        "occupied_thresh": 0.65, "free_thresh": 0.196
    }  # fmt: skip
    rows, columns = cells.shape
    (folder / "map.pgm").write_bytes(f"P5\n{columns} {rows}\n255\n".encode() + cells.tobytes())
    (folder / "map.yaml").write_text("".join(f"{key}: {value}\n" for key, value in (stated | changes).items()))
    return folder / "map.yaml"


def walls():
    """Image of a room of 8 x 6 m, the row of largest y first, with a pillar near its lower left corner."""
    image = np.full((60, 80), 254, np.uint8)
    image[[0, -1]] = 0
    image[:, [0, -1]] = 0
    image[44:48, 12:16] = 0
    return image


@pytest.mark.parametrize("negate", [0, 1])
@pytest.mark.parametrize("yaw_rad", [0.0, 0.5])
def test_a_grid_becomes_a_map_of_its_occupied_cells(tmp_path, negate, yaw_rad):
    image = 255 - walls() if negate else walls()
    import_map(grid_files(tmp_path, image, negate=negate, origin=[1.0, 2.0, yaw_rad]), tmp_path / "room")
    found = open_saved_map(tmp_path / "room")
    assert found.dimension == 2
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    for keyframe, pose in zip(found.keyframes, found.poses, strict=True):
        in_image = (keyframe.points + pose[:2, 2] - [1.0, 2.0]) @ np.array([[c, -s], [s, c]]) / 0.1
        column, row = np.floor(in_image).astype(int).T
        assert (walls()[::-1][row, column] == 0).all()


def outline(*corners):
    """Points along the walls between corners, close enough for any view of them, in the plane of a cloud."""
    ends = zip(corners, (*corners[1:], corners[0]), strict=True)
    walls = [np.linspace(a, b, int(150 * np.linalg.norm(np.subtract(b, a)))) for a, b in ends]
    return np.pad(np.concatenate(walls), ((0, 0), (0, 1)))


def test_a_plan_is_seen_from_inside_its_walls_and_through_none(tmp_path):
    """A building like an L, with a chamber in its corner."""
    building = outline((0, 0), (12, 0), (12, 5), (5, 5), (5, 12), (0, 12))
    write_ply(tmp_path / "plan.ply", np.concatenate([building, outline((1, 1), (4, 1), (4, 4), (1, 4))]))
    import_map(tmp_path / "plan.ply", tmp_path / "out")
    found = open_saved_map(tmp_path / "out")
    positions = found.poses[:, :2, 2]
    assert not (positions > 8.4).all(axis=1).any()  # between its wings, farther out than they reach around
    is_inside = ((positions > 1.0) & (positions < 4.0)).all(axis=1)
    assert 1 <= is_inside.sum() < len(positions) - 4
    for k in np.flatnonzero(is_inside).tolist():
        points = found.keyframes[k].points + positions[k]
        assert points.min() > 0.9 and points.max() < 4.1


def test_the_command_line_is_stated_where_there_was_one(tmp_path):
    grid, out = grid_files(tmp_path, walls()), tmp_path / "room"
    import_map(grid, out)
    assert json.loads((out / "run.json").read_text())["command"] == []
    assert main(["map", "import", str(grid), "--out", str(out), "--force"]) == 0
    assert json.loads((out / "run.json").read_text())["command"] == sys.argv


def test_where_nobody_was_a_grid_is_not_seen_from(tmp_path):
    image = walls()
    image[:, 40:] = np.where(image[:, 40:] == 0, 0, 205)  # unknown
    import_map(grid_files(tmp_path, image), tmp_path / "room")
    assert (open_saved_map(tmp_path / "room").poses[:, 0, 2] < 5.0).all()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.txt", "", "is no map that can be read"),
        ("m.ply", "no ply", "is not a PLY file"),
        ("m.laz", "no laz", "no LAS or LAZ file"),
        ("m.yaml", "image: [", "no map of map_server"),
        ("m.yaml", "image: none.pgm\nresolution: 1", "cannot be read"),
    ],
)
def test_what_is_no_map_is_refused_with_its_name(tmp_path, capsys, name, text, message):
    (tmp_path / name).write_text(text)
    assert main(["map", "import", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "write"), [("m.ply", write_ply), ("m.pcd", write_pcd)])
def test_a_cloud_that_claims_more_points_than_it_has_is_refused(tmp_path, name, write):
    write(tmp_path / name, np.ones((7, 3)))
    (tmp_path / name).write_bytes((tmp_path / name).read_bytes().replace(b" 7\n", b" 4000000000\n"))
    with pytest.raises(InputError, match=f"{name}: ends after 7 of its 4000000000 points"):
        import_map(tmp_path / name, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        *(("resolution", value, "resolution ") for value in (".nan", "0", "-1", "1e300", ".inf")),
        ("origin", "[.nan, 0, 0]", "origin nan"),
        ("image", "huge.pgm", "huge|cells, over|exceeds limit"),
    ],
)
def test_a_grid_that_no_map_has_is_refused_with_its_name(tmp_path, name, value, message):
    (tmp_path / "huge.pgm").write_bytes(b"P5\n12000 12000\n255\n" + bytes(400))
    with pytest.raises(InputError, match=f"map.yaml: is no map of map_server.*({message})"):
        import_map(grid_files(tmp_path, walls(), **{name: value}), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_missing_file_and_a_cloud_without_room_are_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        import_map(tmp_path / "none.ply", tmp_path / "out")
    write_ply(tmp_path / "few.ply", hall()[:50])
    with pytest.raises(InputError, match="nowhere"):
        import_map(tmp_path / "few.ply", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def mapped(folder, pixels, **stated):
    """Cells (row, column) of ``walls`` that the points of all keyframes lie in, of a grid with these pixels."""
    grid_files(folder, np.zeros((1, 1), np.uint8), image="map.png", **stated)
    Image.fromarray(pixels).save(folder / "map.png")
    import_map(folder / "map.yaml", folder / "room")
    found = open_saved_map(folder / "room")
    points = np.vstack([each.points + T[:2, 2] for each, T in zip(found.keyframes, found.poses, strict=True)])
    return np.unique(np.floor((points - [1.0, 2.0]) / 0.1).astype(int)[:, ::-1], axis=0)


OCCUPIED = np.argwhere(walls()[::-1] == 0)


@pytest.mark.parametrize("negate", [0, 1])
def test_of_a_raw_grid_pixels_are_percent_and_255_is_unknown_whatever_negate_is(tmp_path, negate):
    pixels = np.where(walls() == 0, 100, 0).astype(np.uint8)
    pixels[:3, 30:50] = 70
    pixels[3:6, 30:50] = 64  # neither occupied nor free
    pixels[20:30, 30:40] = 255
    cells = mapped(tmp_path, pixels, mode="raw", negate=negate)
    wanted = np.argwhere(np.isin(pixels, (70, 100))[::-1])
    assert {tuple(each) for each in cells} <= {tuple(each) for each in wanted}
    assert len(cells) > 0.8 * len(OCCUPIED)


@pytest.mark.parametrize("mode", ["trinary", "scale"])
@pytest.mark.parametrize("alpha", [0, 128, 254])
def test_cells_that_are_not_opaque_are_unknown(tmp_path, mode, alpha):
    pixels = np.dstack([np.stack([walls()] * 3, axis=-1), np.full(walls().shape, 255, np.uint8)])
    pixels[20:30, 30:40] = (0, 0, 0, alpha)
    cells = mapped(tmp_path, pixels, mode=mode)
    assert {tuple(each) for each in cells} <= {tuple(each) for each in OCCUPIED}
    assert len(cells) > 0.9 * len(OCCUPIED)


def test_pixels_of_sixteen_bits_are_the_same_grid(tmp_path):
    assert np.array_equal(mapped(tmp_path, walls().astype(np.uint16) * 257), OCCUPIED)


def test_an_unknown_mode_is_refused_in_one_line(tmp_path, capsys):
    file = grid_files(tmp_path, walls(), mode="Raw")
    assert main(["map", "import", str(file), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip()
    assert "mode is 'Raw', wanted one of trinary, scale, raw" in error
    assert "\n" not in error


def test_the_raw_grid_of_a_public_report_has_walls_where_they_are(tmp_path):
    import_map(shared_data("reports/j_raw.yaml"), tmp_path / "out")
    found = open_saved_map(tmp_path / "out")
    pixels = np.asarray(Image.open(shared_data("reports/raw.pgm")))[::-1]
    for keyframe, pose in zip(found.keyframes, found.poses, strict=True):
        column, row = np.floor((keyframe.points + pose[:2, 2] - [-5.35, -5.15]) / 0.05 + 1e-6).astype(int).T
        assert (pixels[row, column] == 100).all()


UTM_M = np.array([451234.5, 5412345.25, 300.0])


def ply(path, points, kind):
    """A PLY of float or double numbers."""
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property {kind} {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(head.encode() + points.astype({"float": "<f4", "double": "<f8"}[kind]).tobytes())
    return path


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("rounded", [False, True])
def test_the_step_of_coarse_coordinates_is_said_and_that_it_limits_the_map(tmp_path, capsys, kind, rounded):
    points = hall() + UTM_M
    points = (
        points.astype(np.float32).astype(float)
        if rounded
        else points + 1e-4 * np.sqrt(np.arange(len(points)))[:, None]
    )
    file = ply(tmp_path / "m.ply", points, kind)
    assert main(["map", "import", str(file), "--out", str(tmp_path / "out")]) == 0
    warning = capsys.readouterr().err
    is_coarse = rounded or kind == "float"
    assert ("in steps of 0.5 m there: the map and all poses in it are no more accurate" in warning) == is_coarse


def test_healthy_clouds_are_imported_without_a_note(tmp_path):
    for shift_m in (0.0, 1000.0, 50_000.0):
        file = ply(tmp_path / "m.ply", hall() + shift_m * np.array([1.0, -1.0, 0.0]), "float")
        assert import_map(file, tmp_path / "out", force=True).notes == ()


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_log_is_localized_in_utm_coordinates_as_in_those_about_the_origin(tmp_path, dimension):
    """A drive through the map itself, seen from some of its own keyframes; the room looks alike from both ends."""
    for name, shift_m in (("near", np.zeros(3)), ("utm", UTM_M)):
        if dimension == 3:
            rng = np.random.default_rng(0)
            pillars = np.vstack(
                [rng.uniform([x - 0.3, y - 0.3, 0.0], [x + 0.3, y + 0.3, 3.5], (200, 3)) for x, y in PILLARS]
            )
            file = ply(tmp_path / f"{name}.ply", np.vstack([hall(), pillars]) + shift_m, "double")
        else:
            file = grid_files(tmp_path, walls(), origin=[float(1.0 + shift_m[0]), float(2.0 + shift_m[1]), 0.0])
        import_map(file, tmp_path / name, spacing_m=1.0)
    near, utm = (open_saved_map(tmp_path / name) for name in ("near", "utm"))
    positions = (near.poses[:, :-1, -1], utm.poses[:, :-1, -1] - UTM_M[:dimension])
    np.testing.assert_allclose(*(each[np.lexsort(np.round(each, 3).T)] for each in positions), atol=1e-6)
    path = [k for k in range(len(near.keyframes)) if abs(near.poses[k, 1, -1] - near.poses[0, 1, -1]) < 0.5]
    ends = []
    for prior in (near, utm):
        first = near.poses[path[0]].copy()
        first[:-1, -1] += UTM_M[:dimension] * (prior is utm)
        localizer = Localizer(prior, initial=first if dimension == 2 else None, is_live=False)
        for step, k in enumerate(path):
            points = near.keyframes[k].points.astype(np.float32)
            localizer.process(Scan.of(points, 0.5 * step, index=step))
        ends.append(localizer.finish())
    assert ends[0].is_placed.all() and ends[1].is_placed.all()
    away_m = ends[1].trajectory.poses[:, :-1, -1] - UTM_M[:dimension] - ends[0].trajectory.poses[:, :-1, -1]
    assert np.abs(away_m).max() < 1e-3


PILLARS = ((3.0, 2.0), (5.5, 9.0), (8.0, 4.0), (13.0, 3.0), (14.5, 9.5), (17.0, 5.0))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e7, 3e38])
@pytest.mark.parametrize("count", [1, 20])
def test_a_few_coordinates_that_are_huge_or_not_finite_are_left_out_and_counted(tmp_path, capsys, value, count):
    points = hall()
    points[100 : 100 + count, np.arange(count) % 3] = value
    file = ply(tmp_path / "m.ply", points, "float")
    assert main(["map", "import", str(file), "--out", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert f"of {len(points):,} are left out: coordinates that are not finite, or more than 10 times" in err
    assert f"3D map of {len(points) - count:,} points" in out


@pytest.mark.parametrize("value", [1e7, 1e30, 1e49, 1e300])
def test_a_cloud_of_huge_coordinates_is_refused_in_one_line(tmp_path, value):
    points = hall()
    points[::3, 0] = value * np.linspace(0.5, 1.0, len(points[::3]))
    if value > 1e50:
        points[:] = value
    with pytest.raises(InputError, match=r"m large; give a larger|has no points"):
        import_map(ply(tmp_path / "m.ply", points, "double"), tmp_path / "out")


HUGE = ("9" * 19, "9" * 30, "9" * 5000)


@pytest.mark.parametrize("count", HUGE)
@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_a_cloud_with_a_huge_count_is_refused_in_one_line(tmp_path, count, form):
    point = b"1 2 3\n" if form == "ascii" else struct.pack("<3f", 1, 2, 3)
    pcd = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS {count}\nDATA {form}\n"
    kind = {"ascii": "ascii", "binary": "binary_little_endian"}[form]
    head = f"ply\nformat {kind} 1.0\nelement vertex {count}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    for name, text in (("m.pcd", pcd), ("m.ply", head)):
        (tmp_path / name).write_bytes(text.encode() + point)
        with pytest.raises(InputError, match=name):
            import_map(tmp_path / name, tmp_path / "out")


def test_a_point_with_a_huge_number_of_values_is_refused(tmp_path):
    pcd = "FIELDS x y z d\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 400000000\nPOINTS 1\nDATA ascii\n1 2 3 4\n"
    (tmp_path / "m.pcd").write_text(pcd)
    with pytest.raises(InputError, match="ends after 0 of its 1 points"):
        import_map(tmp_path / "m.pcd", tmp_path / "out")


def test_a_map_of_another_scale_is_said_to_be_another_place_or_scale_and_is_not_merged(tmp_path, call):
    run = made.run("office", tmp_path, seed=2, seconds=20.0)
    log = made.log("office", tmp_path, seed=2, seconds=20.0)
    plan = run / "map.yaml"
    plan.write_text(plan.read_text().replace("resolution: 0.05", "resolution: 0.06"))
    import_map(plan, tmp_path / "plan")
    code, output, _ = call("localize", log, "--map", tmp_path / "plan", "--out", tmp_path / "out")
    assert code == 1 and "matches plan, or the scale of its file is wrong" in unfolded(output)
    code, _, errors = call("merge", run, tmp_path / "plan", "--out", tmp_path / "merged")
    assert code == 2 and "no edges join its keyframes, as in an imported map; merge takes runs" in errors
