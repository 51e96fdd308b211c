"""``scanchain warm-up``: kernels compiled ahead of the first run, for container images and CI."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import click

from scanchain.errors import ScanchainError

_WORLDS = {"2d": ("office", 8), "3d": ("town", 3)}  # with the seconds driven there
_EXPECTED = (0, 1)  # 1: logs this short are not all judged trustworthy


@click.command()
@click.argument("which", default="all", type=click.Choice(("2d", "3d", "all")))
def warm_up(which: str) -> None:
    """Compile what run, localize, merge and simulate need into the cache, instead of in the first of them.

    For container images and CI: a minute or so on two cores, seconds where all is compiled. The cache is of this
    machine's kind of processor; it lies in the folder NUMBA_CACHE_DIR, by default in ~/.cache/scanchain.

    \b
    Examples:
      scanchain warm-up
      scanchain warm-up 2d
    """
    from numba import config

    kinds = tuple(_WORLDS) if which == "all" else (which,)
    click.echo(
        f"compiling what {' and '.join(kind.upper() for kind in kinds)} logs need, once after an installation"
    )
    began = perf_counter()
    with TemporaryDirectory() as folder, ThreadPoolExecutor(len(kinds)) as together:
        for _ in together.map(_go_through, kinds, [Path(folder, kind) for kind in kinds]):
            pass
    where = config.CACHE_DIR or "beside the source"  # pyright: ignore[reportAttributeAccessIssue]
    click.echo(f"compiled in {perf_counter() - began:.0f} s: {where}")


def _go_through(kind: str, folder: Path) -> None:
    """Process a short synthetic log by every command whose kernels are compiled ahead."""
    world, seconds = _WORLDS[kind]
    log, later, run, again = f"{folder}.mcap", f"{folder}_later.mcap", f"{folder}/run", f"{folder}/again"
    for words in (
        ("simulate", world, log, "--duration", f"{seconds}"),
        ("run", log, "--out", run),
        ("simulate", world, later, "--duration", f"{seconds + 1}", "--changed", "1"),
        ("localize", later, "--map", run, "--out", f"{folder}/found"),
        ("run", later, "--out", again, "--rerun", "off"),
        ("merge", run, again, "--out", f"{folder}/merged"),
    ):
        done = subprocess.run(
            [sys.executable, "-P", "-m", "scanchain", *words], capture_output=True, text=True, check=False
        )
        if done.returncode not in _EXPECTED:
            raise ScanchainError(f"scanchain {' '.join(words)}: {done.stderr.strip().rpartition('error: ')[2]}")
