"""``scanchain compare``: comparison of methods on a log."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from scanchain.commands import options
from scanchain.commands.options import PATH, OverrideCommand
from scanchain.errors import ScanchainError
from scanchain.files import Source


@click.command(cls=OverrideCommand)
@options.logs
@click.option("--methods", metavar="LIST", help="Comma-separated names. [default: all that apply to the log]")
@click.option(
    "--matcher",
    metavar="MODULE:CLASS",
    default="",
    help="Compare odometry with your own matcher as well, row CLASS.",
)
@click.option("--out", metavar="DIR", type=PATH, help="Directory to create. [default: runs/compare-LOG]")
@options.ground_truth()
@options.relations
@click.option(
    "--config",
    "--settings",
    "config_file",
    metavar="FILE",
    type=PATH,
    help="TOML file on top of the preset, with a table for each method whose settings differ.",
)
@click.option(
    "--repeat", type=click.IntRange(1), default=1, show_default=True, help="Runs of every method, interleaved."
)
@options.limits("a run", time_default="300, plus 1 per scan", memory_default="three quarters of the free memory")
@options.part()
@options.threads
@options.force("an existing comparison once the new one is complete")
@click.option("--json", "as_json", is_flag=True, help="Print table.json instead of the table.")
def compare(logs: tuple[Source, ...], methods: str | None, out: Path | None, as_json: bool, **given: Any) -> None:
    """Compare odometry methods on the same decoded scans: accuracy, speed, memory.

    Writes tables, report.html and a rerun recording. Every method runs in its own process; one that crashes, hangs
    or runs out of memory becomes a row with the reason, and the exit code is 1. A verdict, also "not trustworthy",
    is a column and fails nothing. Our methods use no wheel odometry unless --odometry.prior is auto, since the
    others have none.

    \b
    Methods:
      plicp, svd               ours, odometry only
      plicp+loops, svd+loops   ours, with loop closures
      CLASS, CLASS+loops       ours with the matcher of --matcher MODULE:CLASS
      open3d-p2p, open3d-gicp, kiss-icp, small-gicp, small-vgicp
      open3d-p2l, genz-icp, genz-icp-indoor, genz-icp-kitti    3D only
      my_module:MyOdometry     your own class, with the methods of scanchain.baselines.Baseline
    A name that several begin with stands for all of them: kiss, open3d. Sections of --config hold for all of
    ours, as in scanchain run; a table of a method's name changes that method, one of another name is a variant:

    \b
      [kiss-icp]
      voxel_size_m = 0.5
      [plicp-fine]
      method = "plicp"
      local_map.voxel_size_m = 0.5
      [mine]
      method = "my_package.odometry:MyOdometry"

    \b
    Examples:
      scanchain compare log.mcap
      scanchain compare log.mcap --methods plicp,kiss,open3d --every 2
      scanchain compare log.mcap --methods plicp,svd,kiss-icp --repeat 5 --out runs/three
      scanchain compare log.mcap --methods plicp,plicp-fine,mine --config mine.toml --gt truth.tum
      scanchain compare log.mcap --methods plicp,Mine --matcher mine:Mine
      scanchain compare intel.mcap --relations intel.relations --memory-limit 2 --end 600
    """
    from scanchain.commands.terminal import Terminal
    from scanchain.comparison.compare import Comparison
    from scanchain.comparison.compare import compare as run_comparison
    from scanchain.comparison.table import TABLE_FILE, text
    from scanchain_viz.recording.results import present_comparison

    comparison = Comparison(
        logs=logs,
        out=Path("runs") / f"compare-{logs[0].stem}" if out is None else out,
        methods=tuple(name.strip() for name in methods.split(",") if name.strip()) if methods else (),
        command=tuple(sys.argv),
        **given,
    )
    with Terminal("scans") as terminal:
        compared = run_comparison(comparison, present_comparison, terminal)
    click.echo((compared.path / TABLE_FILE).read_text() if as_json else text(compared.table), nl=False)
    if not as_json:
        click.echo(f"written {comparison.out}: report.html, compare.rrd, tables")
    if compared.failures:
        raise ScanchainError(f"did not finish: {', '.join(compared.failures)}; see the table for the reason")
