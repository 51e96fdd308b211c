"""The Python of the README runs as it stands, block after block."""

import re

import pytest
from scenes import ROOT

from pipeline.simulate import simulate

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


def test_every_block_of_python_in_the_readme_runs(folder, capsys):
    """Later blocks may use the names of earlier ones."""
    found = blocks(README.read_text(encoding="utf-8"))
    assert found
    names = {"__name__": "readme"}
    for number, block in enumerate(found, start=1):
        exec(compile(block, f"README.md, block {number}", "exec"), names)
    assert "ok" in capsys.readouterr().out
    assert (folder / "trajectory.tum").exists()
