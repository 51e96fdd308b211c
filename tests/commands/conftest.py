"""Commands: successful ones with their directory, refused ones with their line."""

import json
import math
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

FULL = "the disk is full; free some space on it, or write to another one"


@pytest.fixture
def refused(call, tmp_path):
    """Run a command that must fail as bad input: the one line it says."""

    def run(*words):
        before = sorted(tmp_path.rglob("*"))
        code, output, errors = call(*words)
        assert code == 2 and output == ""
        assert re.fullmatch(r"error: [^\n]+\n", errors), errors
        assert not any(word in errors for word in ("Traceback", "Error:", "Errno"))
        assert sorted(tmp_path.rglob("*")) == before, "something was left behind"
        return errors

    return run


@pytest.fixture
def ring(tmp_path):
    """A square of four poses and one false edge across it, as g2o."""
    path = tmp_path / "ring.g2o"
    lines = [f"EDGE_SE2 {i} {(i + 1) % 4} 1 0 {math.pi / 2} 100 0 0 100 0 1000" for i in range(4)]
    path.write_text("\n".join([*lines, "EDGE_SE2 0 2 1 1.01 3.14 100 0 0 100 0 1000", "PARAMS 7"]) + "\n")
    return path


@dataclass(frozen=True)
class Ran:
    """A run of a log by the command line: exit code, output, and its directory."""

    code: int
    output: str
    errors: str
    folder: Path

    @property
    def metrics(self):
        return json.loads((self.folder / "metrics.json").read_text())

    @property
    def config(self):
        return flat((self.folder / "config.toml").read_text())

    @property
    def stamps(self):
        return [line.split()[0] for line in (self.folder / "trajectory.tum").read_text().splitlines()]


def flat(text):
    """The keys of a configuration as TOML."""
    return {f"{a}.{b}": value for a, branch in tomllib.loads(text).items() for b, value in branch.items()}


@pytest.fixture
def ran(call, tmp_path):
    """Run a log without a recording, each time into another directory."""
    count = 0

    def run(*words):
        nonlocal count
        count += 1
        folder = tmp_path / f"run_{count}"
        return Ran(*call("run", *words, "--rerun", "off", "--out", folder), folder)

    return run
