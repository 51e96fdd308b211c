"""Every example of README and docs runs as it stands and comes out as printed beside it.

Scripts of docs/examples run alone, each in an empty folder. Of a page, in order and in one empty folder:
``python`` fences run alone; after ``# -> `` stands what their statement prints,
``console`` fences run the ``scanchain`` commands after ``$ ``; the lines below are printed in that order,
fences whose first line is a comment with nothing but a name, as ``# mine.toml``, are files, and so are those that
include a script of docs/examples.
Whole numbers agree exactly, others within one unit of the last digit shown.
"""

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from scanchain.__main__ import main
from scanchain.odometry import jackknife
from tests.support.scenes import ROOT, SHORT_WINDOWS

pytestmark = pytest.mark.error_bars

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
GIVEN = {  # what a page takes as done
    "results.md": ("simulate office log.mcap --duration 20", "run log.mcap --out runs/log --rerun off")
}
LONG = ("extending.md", "maps.md")
WITHOUT_ERROR_BARS = ("extending.md", "index.md", "logs.md", "maps.md")  # none are quoted
SCRIPTS = sorted((ROOT / "docs" / "examples").glob("*.py"))
FENCE = re.compile(r"^(`{3,})(\w+)\n(.*?)^\1$", re.DOTALL | re.MULTILINE)
FILE = re.compile(r"# (\w+\.\w+)\n")
INCLUDED = re.compile(r"^```\{literalinclude\} (examples/\w+\.py)$", re.MULTILINE)
NUMBER = re.compile(r"[-+]?\d[\d,]*(?:\.\d*)?(?:e[-+]?\d+)?", re.IGNORECASE)
PRINTS = re.compile(r"# -> (.*)$")


def fences(text):
    """Language and contents of each fence that names a language."""
    return [(language, contents) for _, language, contents in FENCE.findall(text)]


def agree(said, printed):
    """Whether a line printed is the one that the page says; ``...`` at its end leaves out the further words."""
    if said.endswith("..."):
        words = said.removesuffix("...").split()
        return agree(" ".join(words), " ".join(printed.split()[: len(words)]))
    if re.sub(r"\s", "", NUMBER.sub("#", said)) != re.sub(r"\s", "", NUMBER.sub("#", printed)):
        return False
    wanted, found = (NUMBER.findall(text.replace(",", "")) for text in (said, printed))
    decimals = [len(number.partition(".")[2].lower().partition("e")[0]) for number in wanted]
    return all(
        abs(float(a) - float(b)) <= (unit(a, n or max(decimals)) if "." in a or "e" in a.lower() else 0.0)
        for a, b, n in zip(wanted, found, decimals, strict=True)
    )


def unit(number, decimals):
    """One unit of the last digit shown, and what rounding leaves."""
    _, _, exponent = number.lower().partition("e")
    return 1.000001 * 10.0 ** (int(exponent or 0) - decimals)


def run_python(source, name, capsys):
    """Run a block statement by statement, and compare what is printed with what is said."""
    lines, scope, compared = source.splitlines(), {"__name__": "example"}, 0
    for statement in ast.parse(source).body:
        exec(compile(ast.Module([statement], []), name, "exec"), scope)
        printed = " ".join(capsys.readouterr().out.split("\n")).strip()
        said = PRINTS.search(lines[statement.end_lineno - 1])
        if said:
            assert agree(said[1], printed), f"{name}: says {said[1]!r}, prints {printed!r}"
            compared += 1
    assert compared == len(re.findall("# ->", source)), f"{name}: `# ->` stands at the end of a statement"
    return compared


def run_console(text, name, capsys):
    """Run the commands of a block, and look for the lines that follow them in what they print."""
    compared = 0
    for command, said in re.findall(r"^\$ (.*)\n((?:[^$].*\n|\n)*)", text, re.MULTILINE):
        words = shlex.split(command, comments=True)
        assert words[0] == "scanchain", f"{name}: {command}: only scanchain is run; make it a `sh` fence"
        code = main(words[1:])
        output, errors = capsys.readouterr()
        assert code == 0, f"{name}: {command} ended with {code}: {errors}"
        printed = iter(output.splitlines())
        for line in said.strip().splitlines():
            assert any(agree(line, other) for other in printed), (
                f"{name}: {command} does not print {line!r}:\n{output}"
            )
            compared += 1
    return compared


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, in which this process and those it starts find modules, and the command."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    return tmp_path


@pytest.mark.parametrize(
    "page",
    [pytest.param(page, marks=[pytest.mark.slow] * (page.name in LONG)) for page in PAGES],
    ids=lambda page: page.name,
)
def test_every_example_prints_what_the_page_says(page, folder, capsys, monkeypatch):
    if page.name in WITHOUT_ERROR_BARS:
        monkeypatch.setattr(jackknife, "LONGEST", SHORT_WINDOWS)
    compared = ran = 0
    text = page.read_text(encoding="utf-8")
    for command in GIVEN.get(page.name, ()) if "```python" in text else ():
        assert main(command.split()) == 0
    capsys.readouterr()
    for name in INCLUDED.findall(text):
        shutil.copy(ROOT / "docs" / name, folder)
    for number, (language, contents) in enumerate(fences(text), start=1):
        name = f"{page.name}, block {number}"
        if file := FILE.match(contents):
            (folder / file[1]).write_text(contents, encoding="utf-8")
        elif language in ("python", "console"):
            compared += (run_python if language == "python" else run_console)(contents, name, capsys)
            ran += 1
    assert compared or not ran, f"{page.name}: no example says what it prints"


@pytest.mark.parametrize(
    "script",
    [pytest.param(script, marks=[pytest.mark.slow] * (script.stem == "ray_batch")) for script in SCRIPTS],
    ids=lambda script: script.stem,
)
def test_every_script_prints_what_it_says(script, folder, capsys, monkeypatch):
    monkeypatch.setattr(jackknife, "LONGEST", SHORT_WINDOWS)
    source = script.read_text(encoding="utf-8")
    if "import ray" in source:
        pytest.importorskip("ray", reason="the extra cluster is not installed")
        monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    assert run_python(source, script.name, capsys) or script.name.startswith("my_")


@pytest.mark.slow
def test_examples_and_their_results_pass_a_type_checker_where_the_package_is_installed(tmp_path):
    examples = tmp_path / "examples"
    examples.mkdir()
    for page in PAGES:
        for number, (language, contents) in enumerate(fences(page.read_text(encoding="utf-8"))):
            if language == "python":
                (examples / f"{page.stem}_{number}.py").write_text(contents, encoding="utf-8")
    for script in SCRIPTS:
        shutil.copy(script, examples)
    (examples / "further.py").write_text(FURTHER, encoding="utf-8")
    options = {
        "include": ["examples"],
        "extraPaths": [str(ROOT / "pipeline"), str(ROOT / "viz")],
        "typeCheckingMode": "standard",
    }
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(options | {"reportMissingTypeStubs": False}))
    checker = Path(sys.executable).with_name("basedpyright")
    if not checker.exists():
        pytest.skip("basedpyright is not installed")
    command = [checker, "--pythonpath", sys.executable, "--project", tmp_path]
    checked = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout


FURTHER = """
import numpy as np
import scanchain
from scanchain.evaluation import sharpness

print(scanchain.align(np.zeros((9, 3)), np.zeros((9, 3), np.float32)).converged)
found = scanchain.evaluate("a.tum", "b.tum")
print(found.ate.translation_m.rmse, found.rpe["1_s"].rotation_rad.mean, found.kitti.translation_share)
print(scanchain.__version__, scanchain.lie.exp(np.zeros(6)), scanchain.evaluation.pair)
print(sharpness([np.zeros((9, 3))]))
scanchain.Odometry().process(scanchain.Scan.of(np.zeros((9, 3)), 0.0, np.zeros(9)))
"""


def test_an_example_that_prints_something_else_fails(capsys):
    assert agree("1.69 ok ...", "1.6981 ok so far") and not agree("1.69 ok", "1.7011 ok")
    for source in ("print(1)  # -> 2\n", "for k in (1,):\n    x = 1  # -> 2\n    y = 1\n"):
        with pytest.raises(AssertionError):
            run_python(source, "example", capsys)
    assert run_console("$ scanchain config dump --lidar 2d\n[log]\n[matching]\n", "example", capsys) == 2
    for text in ("$ scanchain config dump\n[matching]\n[log]\n", "$ scanchain info absent.mcap\n", "$ ls\n"):
        with pytest.raises(AssertionError):
            run_console(text, "example", capsys)
