"""Kernels are compiled ahead, each once and after those that it calls; the table has what runs call."""

import json
import os
import subprocess
import sys
from pathlib import Path
from time import sleep

import pytest
from numba import config

from scanchain import ahead
from scanchain.__main__ import main
from scanchain.clock import compiled_s, working_s
from scanchain.commands.terminal import Terminal
from scanchain.kernels import compiling
from tests.support import made
from tests.support.signatures import words_of


class Fake:
    """A process that compiles, of a test: what it was told; one that has failed at the kernel ``fails_at``."""

    told: list[tuple[str, str]]
    fails_at = ""

    def __init__(self, kinds):
        self.kinds = kinds

    def __enter__(self):
        return self

    def __exit__(self, *raised):
        pass

    def compile(self, name):
        self.told.append(("begun", name))
        self.told.append(("done", name))
        return name != self.fails_at


@pytest.fixture
def faked(tmp_path, monkeypatch):
    for each in ahead.signatures():  # a module that is imported later would keep its kernels in this folder
        ahead._named(each.kernel)
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(ahead, "_Worker", Fake)
    monkeypatch.setattr(Fake, "told", [], raising=False)
    return Fake


def compiled(kinds=("2d",), counts=None):
    return ahead.compile_ahead(kinds, lambda done, total: counts is None or counts.append((done, total)))


def test_each_kernel_is_compiled_once_after_those_that_it_calls_and_not_again(faked):
    counts = []
    assert compiled(counts=counts)
    names = [name for what, name in faked.told if what == "done"]
    assert sorted(names) == sorted({each.kernel for each in ahead.signatures(["2d"])})
    assert counts == [(done, len(names)) for done in range(1, len(names) + 1)]
    calls = {name: ahead._called(ahead._named(name), set(names)) - {name} for name in names}
    assert "kernels.registration.icp:align" in calls["kernels.registration.match:match"]
    assert (
        "kernels.registration.residuals:normal_equations" in calls["kernels.registration.match:_result"]
    )  # by inlined ones, too
    for name, called in calls.items():
        for each in called:
            assert faked.told.index(("done", each)) < faked.told.index(("begun", name)), (each, name)
    heights = ahead._heights(calls)
    assert (
        heights["kernels.registration.match:match"] < heights["kernels.registration.icp:align"]
    )  # what is waited for comes first
    faked.told.clear()
    assert compiled() and not faked.told
    assert compiled(("2d", "3d")) and {name for _, name in faked.told} > {"kernels.voxels:insert"}


def test_what_is_known_to_be_compiled_changes_with_the_sources_and_versions(faked, monkeypatch):
    compiled()
    monkeypatch.setattr(ahead, "_state", lambda: "another")
    faked.told.clear()
    assert compiled() and faked.told


def test_another_installation_of_the_same_sources_is_not_taken_for_compiled(tmp_path, monkeypatch):
    here = ahead._state.__wrapped__()
    monkeypatch.setattr(ahead, "TABLE", tmp_path / "signatures.json")
    ahead.TABLE.write_bytes(Path(compiling.__file__).with_name("signatures.json").read_bytes())
    assert ahead._state.__wrapped__() != here  # numba looks for its kernels in another folder


def test_where_a_process_ends_early_or_nothing_can_be_kept_calls_compile_what_they_need(
    faked, monkeypatch, capsys
):
    monkeypatch.setattr(faked, "fails_at", "kernels.voxels:insert")
    assert not compiled()
    assert {each.kernel for each in ahead.signatures(["2d"])} == {name for _, name in faked.told}  # by the others
    faked.told.clear()
    monkeypatch.setenv("SCANCHAIN_THREADS", "1")
    assert not compiled() and faked.told[-1] == ("done", "kernels.voxels:insert")  # tried again; nobody is left
    monkeypatch.delenv("SCANCHAIN_THREADS")
    assert main(["warm-up", "2d"]) == 1
    assert capsys.readouterr().err.startswith("error: a process that compiles ended early")
    monkeypatch.setattr(config, "CACHE_DIR", "")
    faked.told.clear()
    assert not compiled() and not faked.told
    assert main(["warm-up"]) == 1
    assert "set NUMBA_CACHE_DIR" in capsys.readouterr().err


def test_the_command_says_where_and_draws_how_many(faked, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert main(["warm-up", "3d"]) == 0
    told = capsys.readouterr()
    assert told.out.startswith("compiled in ") and told.out.endswith(f": {tmp_path}\n")
    total = len({each.kernel for each in ahead.signatures(["3d", "rest"])})
    assert f"\r\033[Kcompiling kernels, once after an installation: 7 of {total}\r" in told.err
    assert told.err.endswith(f"{total} of {total}\n")
    monkeypatch.setattr("sys.stderr.isatty", lambda: False)
    with Terminal("kernels") as terminal:
        terminal.compiling(1, 2)
    assert capsys.readouterr().err == ""


def test_it_keeps_what_it_compiles_where_kernels_are_looked_for(tmp_path):
    variables = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    code = "from scanchain import ahead; from numba import config; print(config.CACHE_DIR)"
    words, place = [sys.executable, "-c", code], variables | {"XDG_CACHE_HOME": str(tmp_path)}
    told = subprocess.run(words, env=place, capture_output=True, text=True, check=True).stdout
    assert told.startswith(f"{tmp_path}/scanchain/kernels/")


def test_the_time_counts_as_compiling(faked, monkeypatch):
    monkeypatch.setattr(ahead, "_compile_all", lambda *_: sleep(0.2) is None)
    before_s, before_work_s = compiled_s(), working_s()
    assert compiled()
    assert compiled_s() - before_s >= 0.2 and working_s() - before_work_s < 0.1


def test_a_process_compiles_what_another_then_takes_from_the_cache(tmp_path, monkeypatch):
    name = "kernels.matrices:eigenvalues_3d"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    kinds = next(each.kinds for each in ahead.signatures() if each.kernel == name)
    for key, value in environment.items():
        monkeypatch.setenv(key, value)
    with ahead._Worker(kinds) as worker:
        assert worker.compile(name)
        worker.process.kill()
        worker.process.wait()
        assert not worker.compile(name)
    code = f"from scanchain import ahead; k = ahead._named({name!r})\n"
    code += f"for each in ahead.signatures(): each.kernel == {name!r} and k.compile(each.types)\n"
    code += "print(sum(k.stats.cache_hits.values()), sum(k.stats.cache_misses.values()))"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    hits, misses = map(int, done.stdout.split())
    assert hits and not misses


def test_the_table_says_of_types_what_it_says_of_them_when_written_again():
    tuples = {}
    table = json.loads(ahead.TABLE.read_text())
    words = [words_of(each.types, tuples) for each in ahead.signatures()]
    assert words == [row[2:] for row in table["kernels"]]
    assert tuples == {name: fields for name, fields in table["tuples"].items() if name in tuples}


@pytest.mark.parametrize("kind", ["2d", "3d"])
def test_the_table_has_what_runs_call(kind, tmp_path):
    """Where this fails: python -m tests.support.signatures."""
    world = {"2d": "office", "3d": "town"}[kind]
    made.log(world, tmp_path, seconds=3)
    words = [sys.executable, "-m", "tests.support.signatures", str(tmp_path), kind]
    subprocess.run(words, check=True, capture_output=True)
    _, called = json.loads((tmp_path / f"{kind}.json").read_text())
    table = [row[1:] for row in json.loads(ahead.TABLE.read_text())["kernels"] if kind in row[0]]
    assert len(called) > 20
    assert [each for each in called if each not in table] == []


def test_every_kernel_in_the_table_takes_as_many_arguments_as_it_is_compiled_for():
    for each in ahead.signatures():
        assert ahead._named(each.kernel).py_func.__code__.co_argcount == len(each.types), each.kernel
