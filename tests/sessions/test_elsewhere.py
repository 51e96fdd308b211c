import numpy as np
import pytest

from scanchain.__main__ import main
from scanchain.errors import InputError
from scanchain.maps import open_saved_map, write_laz, write_pcd, write_ply
from scanchain.sessions.elsewhere import import_map


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


def test_where_nobody_was_a_grid_is_not_seen_from(tmp_path):
    image = walls()
    image[:, 40:] = np.where(image[:, 40:] == 0, 0, 205)  # unknown
    import_map(grid_files(tmp_path, image), tmp_path / "room")
    assert (open_saved_map(tmp_path / "room").poses[:, 0, 2] < 5.0).all()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.txt", "", "is no map that can be read"),
        ("m.ply", "no ply", "is no PLY"),
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
