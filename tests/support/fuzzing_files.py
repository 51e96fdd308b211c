"""Judging how damaged files that are no logs are read: arrays, landmarks, graphs, maps, tables of runs."""

import json
import warnings
import zipfile
import zlib
from functools import partial
from io import BytesIO
from pathlib import Path

import numpy as np

import scanchain
from scanchain import lie
from scanchain.data import Keyframe
from scanchain.errors import InputError
from scanchain.landmarks.files import read_landmark_data
from scanchain.logs.formats.clouds import CloudFileError, read_cloud_file
from scanchain.maps import Edges, SavedMap, SavedPoints, Session, open_saved_map, write_laz, write_saved_map
from scanchain.maps.files import read_las
from scanchain.runs.judging import judge_run
from tests.support import made
from tests.support.fuzzing import within_bounds
from tests.support.mutations import any_mutant

SLOW = 40  # as many cases fewer of what starts a process


def kinds(folder):
    """By name: the file that is damaged, how it is stored, what reads it."""
    random = np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    cloud = folder / "1.npy"
    np.save(cloud, random.uniform(-9, 9, (40, 4)).astype("f4"))
    yield "npy", cloud, _as_it_is, partial(read_cloud_file, cloud)
    problem = folder / "problem.npz"
    shapes = {"odom": (2, 2), "observations": (4, 4), "sigma_odom": (2, 2), "sigma_landmark": (2, 2)}
    np.savez(problem, **{name: np.ones(shape) for name, shape in shapes.items()})
    for place in range(len(shapes)):
        yield f"landmarks {place}", problem, partial(_in_archive, place), partial(read_landmark_data, problem)
    yield "landmarks zip", problem, _as_it_is, partial(read_landmark_data, problem)
    graph = folder / "graph.g2o"
    graph.write_text("".join(f"EDGE_SE2 {k} {k + 1} 1 0 0.1 100 0 0 100 0 1000\n" for k in range(9)))
    yield "g2o", graph, _as_it_is, partial(scanchain.read_g2o, graph)
    place = _map(folder / "map")
    for name in ("keyframes.npz", "edges.npz", "points.i16"):
        members = len(zipfile.ZipFile(place / name).namelist()) if name.endswith("npz") else 1
        for member in range(members):
            change = partial(_in_archive, member) if name.endswith("npz") else _as_it_is
            yield f"map {name} {member}", place / name, partial(_with_crc, change), partial(_all_points, place)
    yield "map.json", place / "map.json", _as_it_is, partial(_all_points, place)
    laz = folder / "m.laz"
    write_laz(laz, random.uniform(-9, 9, (3000, 3)))
    yield "laz", laz, _as_it_is, partial(read_las, laz)


def run_kinds(folder):
    """As ``kinds``, of a run directory."""
    run = made.run("office", folder, log__end_s=4.0)
    for name in ("steps.parquet", "loops.parquet"):
        yield name, run / name, _as_it_is, partial(judge_run, run)


def complaints(made_kinds, rng, count):
    """Each damaged file that is read badly: what it is, what was done to it, and what is wrong."""
    for name, path, change, act in made_kinds:
        others = {each: each.read_bytes() for each in path.parent.iterdir() if each.is_file()}
        for _ in range(count // SLOW if name == "laz" else count):
            what = change(path, rng)
            problem, _ = within_bounds(partial(_read, act), seconds=60.0 if name == "laz" else 5.0)
            for each, data in others.items():
                each.write_bytes(data)
            if problem:
                yield f"{name}: {what}: {problem}"


def _read(act):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", UserWarning)
        try:
            act()
        except (InputError, CloudFileError) as error:
            assert "\n" not in str(error), error


def _as_it_is(path, rng):
    mutant = any_mutant(path.read_bytes(), rng)
    path.write_bytes(mutant.data)
    return mutant.what


def _in_archive(place, path, rng):
    """Damage in a member of an archive, whose checksum is right."""
    with zipfile.ZipFile(path) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    name, data = members[place]
    mutant = any_mutant(data, rng)
    members[place] = name, mutant.data
    written = BytesIO()
    with zipfile.ZipFile(written, "w") as archive:
        for each in members:
            archive.writestr(*each)
    path.write_bytes(written.getvalue())
    return f"{name}: {mutant.what}"


def _with_crc(change, path, rng):
    """A change of a map's file whose new checksum is stated."""
    what = change(path, rng)
    stated = json.loads((path.parent / "map.json").read_bytes())
    stated["crc32"][path.name] = zlib.crc32(path.read_bytes())
    (path.parent / "map.json").write_text(json.dumps(stated))
    return what


def _map(folder: Path):
    keyframes = tuple(
        Keyframe(k, k, k, SavedPoints(np.ones((9, 2)) * k, 1.0), lie.identity(2), 1.0 * k, 1.0) for k in range(3)
    )
    pairs, eyes = np.array([[0, 1], [1, 2]]), np.tile(np.eye(3), (2, 1, 1))
    edges = Edges(pairs, eyes, eyes, np.array([False, True]), np.ones(2))
    write_saved_map(SavedMap(folder, 2, keyframes, np.zeros(3, int), (Session("a", 0, 2, 3),), edges))
    return folder


def _all_points(place):
    saved = open_saved_map(place)
    for keyframe in saved.keyframes:
        assert keyframe.points.shape[1] == saved.dimension
    assert saved.poses.shape == (len(saved.keyframes), saved.dimension + 1, saved.dimension + 1)
