"""The Python of the README runs as it stands, block after block."""

import re

import pytest
from scenes import ROOT

import scanchain
from scanchain.simulation import simulate

README = ROOT / "README.md"


def blocks(text):
    return re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where log.mcap and truth.tum lie: three seconds of the simulated town."""
    monkeypatch.chdir(tmp_path)
    simulate("town", tmp_path / "log.mcap", duration_s=3.0, sensor="vlp-16")
    (tmp_path / "log.tum").rename(tmp_path / "truth.tum")
    return tmp_path


def test_blocks_are_found_between_their_fences():
    assert blocks("a\n```python\nb = 1\n```\n```\nno\n```\n```python\nc = 2\n```\n") == ["b = 1\n", "c = 2\n"]


def test_every_block_of_python_in_the_readme_runs_alone(folder, capsys):
    """In the order of the README: only the files that a block writes are there for the next."""
    printed = []
    for number, block in enumerate(blocks(README.read_text(encoding="utf-8")), start=1):
        exec(compile(block, f"README.md, block {number}", "exec"), {"__name__": "readme"})
        printed.append(capsys.readouterr().out)
    slam, clouds, stream, graph, errors = printed
    assert re.findall(r"^(\d+) ok ", slam, re.MULTILINE) == [str(k) for k in range(30)]
    assert clouds.startswith("True converged")
    assert re.findall(r"^(\w+) \[", stream, re.MULTILINE) == ["ok"] * 30
    assert "3.00" in graph and graph.rstrip().endswith("3")
    ate_m = float(re.search(r"rmse ([\d.]+) m", errors)[1])
    assert ate_m < 0.02
    assert (folder / "trajectory.tum").exists()


def test_the_names_of_the_api_are_listed():
    assert {name for name in dir(scanchain) if not name.startswith("_")} == set(scanchain.__all__)
