"""The matcher of docs/examples, outside the package: named on the command line, compared, stopped, resumed."""

import subprocess
import sys
import time

import numpy as np
import pytest

from scanchain.comparison.methods import resolve
from scanchain.comparison.processes import Status
from scanchain.comparison.table import read_table
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.errors import InputError
from scanchain.registration import VoxelMap, create_matcher
from scanchain.runs.directory import CHECKPOINT_FILE
from tests.support import made
from tests.support.killing import same_result
from tests.support.scenes import ROOT

MATCHER = (ROOT / "docs" / "examples" / "my_matcher.py").read_text(encoding="utf-8")
NAME = "my_matcher:PointToPoint"


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """Half a minute in the simulated office, 300 scans."""
    return made.log("office", tmp_path_factory.mktemp("log"), seconds=30)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with the user's module."""
    (tmp_path / "my_matcher.py").write_text(MATCHER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each not in ("", str(tmp_path))])
    return tmp_path


def started(folder, *words):
    """A command as a user gives it, in the folder of the module, which is on no path."""
    command = [sys.executable, "-P", "-m", "scanchain", *map(str, words)]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_it_runs_is_stopped_and_goes_on_to_the_same_result(office, folder):
    words = ("run", office, "--matcher", NAME, "--end", "3", "--error-bars", "quick", "--rerun", "off")
    words = (*words, "--checkpoint", "0.1")
    whole = started(folder, *words, "--out", "whole")
    assert whole.wait() == 0, whole.stderr.read()
    assert NAME in (folder / "whole" / "config.toml").read_text()
    child = started(folder, *words, "--out", "run")
    while not list(folder.glob(f"run.partial-*/{CHECKPOINT_FILE}")):  # which only a process with the module opens
        assert child.poll() is None, "the run ended before"
        time.sleep(0.02)
    child.kill()
    child.wait()
    again = started(folder, *words, "--out", "run", "--resume")
    assert again.wait() == 0, again.stderr.read()
    same_result(folder / "run", folder / "whole")
    assert "note           resumed after" in (folder / "run" / "summary.txt").read_text()


@pytest.mark.slow
def test_it_is_a_row_of_a_comparison_and_its_settings_can_be_given_back(office, folder):
    names, short = ("svd", "PointToPoint"), ("--log.end_s", "2")
    words = ("compare", office, *short, "--methods", ",".join(names), "--matcher", NAME, "--out", "a")
    child = started(folder, *words)
    _, errors = child.communicate()
    assert child.returncode == 0, errors
    svd, own = read_table(folder / "a").rows
    assert own.status is Status.OK and NAME in own.description
    assert own.figures["ate_m"] < 0.1 and own.figures["ate_m"] != svd.figures["ate_m"]
    given = resolve(names, 2, file=None, matcher=NAME)
    again = resolve(names, 2, file=folder / "a" / "settings.toml")
    for one, other in zip(again, given, strict=True):
        assert (one.name, one.base, one.settings) == (other.name, other.base, other.settings)


def test_one_added_to_the_methods_needs_no_name_of_its_own_there(folder):
    for names in (("svd",), ("svd", "PointToPoint+loops")):
        chosen = [method.name for method in resolve(names, 2, file=None, matcher=NAME)]
        assert chosen == list(names if len(names) > 1 else (*names, "PointToPoint"))
    assert [method.name for method in resolve(("svd",), 2, file=None, matcher="plicp")] == ["svd", "plicp"]
    with pytest.raises(InputError, match="no module absent"):
        resolve(("svd",), 2, file=None, matcher="absent:Matcher")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("my_match:PointToPoint", "on PYTHONPATH; go to its folder, or set PYTHONPATH to it"),
        ("my_matcher:PointToPlane", "has no class PointToPlane"),
        ("my_matcher:KDTree", "has no method align"),
        ("broken:Matcher", "importing broken failed with SyntaxError"),
        ("needy:Matcher", "No module named 'not_there' (File \"{folder}/needy.py\", line 1, in <module>)"),
        ("my_matcher.PointToPoint", "one of plicp, svd or a class of yours, MODULE:CLASS"),
    ],
)
def test_one_that_cannot_be_had_is_one_line_that_says_why(folder, name, words):
    (folder / "broken.py").write_text("class Matcher(:\n")
    (folder / "needy.py").write_text("import not_there\n")
    with pytest.raises(InputError) as raised:
        create_matcher(MatchingConfig(matcher=name))
    assert words.format(folder=folder) in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "def __init__(self, config):",
            "def __init__(self):",
            r"__init__\(self, config\) with a MatchingConfig failed with TypeError",
        ),
        (
            "return Match(",
            "return T; Match(",
            r"align returned an array of the shape \(3, 3\); wanted a scanchain.Match",
        ),
        ("information=np.eye(k)", "information=np.eye(6)", r"information has the shape \(6, 6\); wanted \(3, 3\)"),
        ("T_target_source=T,", "T_target_source=2.0 * T,", "T_target_source is not a rigid transformation"),
        ("inliers=inliers,", "inliers=None,", "inliers is None; wanted a whole number"),
        ("inliers=inliers,", "inliers=inliers, fit='good',", "fit is 'good'; wanted a number"),
    ],
)
def test_one_that_returns_something_else_is_one_line_that_names_it(folder, old, new, words):
    module = f"own_{abs(hash(new))}"
    (folder / f"{module}.py").write_text(MATCHER.replace(old, new))
    wall = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 2))
    target = VoxelMap(2, LocalMapConfig())
    target.insert(wall, np.eye(3))
    with pytest.raises(InputError, match=f"^{module}:PointToPoint.*{words}"):
        create_matcher(MatchingConfig(matcher=f"{module}:PointToPoint")).align(wall, target, np.eye(3))


def test_one_that_raises_is_named_with_file_and_line_and_leaves_no_directory(folder, call):
    line = MATCHER.splitlines().index(next(each for each in MATCHER.splitlines() if "return Match(" in each)) + 1
    (folder / "raising.py").write_text(MATCHER.replace("return Match(", "np.linalg.inv(np.zeros((2, 2))); Match("))
    log = made.log("office", folder, seconds=6)
    words = ("run", log, "--matcher", "raising:PointToPoint", "--rerun", "off", "--out", "out")
    where = f'align failed with LinAlgError: Singular matrix (File "{folder}/raising.py", line {line}, in align)'
    code, _, error = call(*words)
    assert (code, error) == (2, f"error: raising:PointToPoint: {where}; --debug shows the traceback\n")
    code, _, error = call(*words, "--debug")
    assert code == 2 and error.startswith("Traceback (most") and error.endswith(f"PointToPoint: {where}\n")
    assert "np.linalg.inv(np.zeros((2, 2)))" in error
    assert [path.name for path in folder.iterdir() if path.name.startswith("out")] == []


def test_the_working_directory_comes_last(folder, monkeypatch):
    (folder / "numpy.py").write_text("raise RuntimeError('a stranger')\n")
    monkeypatch.delitem(sys.modules, "my_matcher", raising=False)
    before = [*sys.path]
    assert callable(create_matcher(MatchingConfig(matcher=NAME)).align)
    assert sys.path[: len(before)] == before and str(folder) in sys.path
    code = f"from scanchain import plugins; plugins.load({NAME!r}, 'align')"
    assert subprocess.run([sys.executable, "-P", "-c", code], cwd=folder).returncode == 0
    assert np.__file__ != str(folder / "numpy.py")
