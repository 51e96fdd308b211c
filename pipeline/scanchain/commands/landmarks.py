"""``scanchain landmarks``: landmark problems solved, on request by several linear solvers side by side."""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from scanchain.errors import InputError

if TYPE_CHECKING:
    from scanchain.landmarks.estimate import Optimizer
    from scanchain.landmarks.ranges import OdometryNoise
    from scanchain.landmarks.study import Guess, Study


@click.command()
@click.argument("data", metavar="DATA...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    required=True,
    metavar="DIR",
    type=click.Path(path_type=Path),
    help="Directory to create.",
)
@click.option(
    "--methods",
    "--method",
    "methods",
    default="schur",
    show_default=True,
    metavar="NAME,...",
    help="Linear solvers: one to solve with, several (or all) to compare.",
)
@click.option(
    "--repeat",
    type=click.IntRange(1, 1000),
    default=3,
    show_default=True,
    help="Timed repetitions; the median is reported.",
)
@click.option("--robot", type=click.IntRange(1), default=1, show_default=True, help="Robot of an MRCLAM folder.")
@click.option(
    "--odometry-noise",
    "noise",
    metavar="FORWARD,SIDEWAYS,DRIFT,TURN",
    help="Standard deviations of an MRCLAM robot: m, m, rad per meter; rad per radian. [default: estimated]",
)
@click.option(
    "--guess",
    type=click.Choice(["odometry", "disturbed", "origin"]),
    default="odometry",
    show_default=True,
    help="Initial guess of a nonlinear file: odometry, disturbed by 1 m and 0.5 rad, or landmarks at the origin.",
)
@click.option(
    "--optimizer",
    type=click.Choice(["levenberg-marquardt", "gauss-newton", "dogleg", "gradient-descent"]),
    default="levenberg-marquardt",
    show_default=True,
    help="Optimizer for a nonlinear file.",
)
@click.option(
    "--recording", metavar="FILE.rrd", type=click.Path(path_type=Path), help="Record before and after for rerun."
)
@click.option("--force", is_flag=True, help="Replace DIR if it is the result of an earlier run.")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
@click.pass_context
def landmarks(
    ctx: click.Context,
    data: tuple[Path, ...],
    out: Path,
    methods: str,
    repeat: int,
    robot: int,
    noise: str | None,
    guess: Guess,
    optimizer: Optimizer,
    recording: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Solve landmark SLAM problems, and compare linear solvers on them.

    DATA is an npz file with a linear problem or with bearing and range measurements, or a folder of the UTIAS
    MRCLAM data sets, of which the log of one robot is used. Estimates, pictures and report.html go to DIR.

    Methods: default, pinv (below 3,000 unknowns), lu, lu_colamd, qr, qr_colamd, cholesky, schur, or all of them;
    with the package sparseqr also spqr and spqr_colamd. The log of a robot is always estimated by schur; the
    others are compared on its linear system.

    \b
    Examples:
      scanchain landmarks 2d_linear.npz --out runs/linear
      scanchain landmarks 2d_linear.npz 2d_linear_loop.npz --methods all --out runs/solvers
      scanchain landmarks 2d_nonlinear.npz --guess origin --methods cholesky,schur --out runs/nonlinear
      scanchain landmarks 2d_nonlinear.npz --optimizer dogleg --out runs/dogleg --recording dogleg.rrd
      scanchain landmarks MRCLAM_Dataset6 --robot 1 --out runs/mrclam --json
    """
    from scanchain.clock import announcing_compilation
    from scanchain.commands.options import check_output
    from scanchain.commands.terminal import Terminal
    from scanchain.landmarks.files import read_landmark_data
    from scanchain.landmarks.results import text_of, tree_of
    from scanchain.landmarks.solvers import parse_methods
    from scanchain.landmarks.study import Options, study_file, study_log
    from scanchain.runs.directory import RunDirectory
    from scanchain_viz.report.problems import write_report

    options = Options(parse_methods(methods), repeat, robot, _noise(noise), guess, optimizer)
    problems = [path if path.is_dir() else read_landmark_data(path) for path in data]
    _check_options(ctx, {"log" if isinstance(each, Path) else each.kind for each in problems})
    if recording is not None:
        check_output(recording, force=force, endings=(".rrd",))
    with RunDirectory(out, force=force) as directory, Terminal("problems") as terminal:
        with announcing_compilation(terminal.say):
            studies = [
                study_log(each, options) if isinstance(each, Path) else study_file(each, options)
                for each in problems
            ]
        _check_names(studies)
        tree: dict[str, object] = {"problems": [tree_of(study) for study in studies]}
        _write(directory.path, data, studies, tree)
        write_report(directory.path, studies)
        if recording is not None:
            from scanchain_viz.recording.results import record_landmarks

            record_landmarks(studies, recording)
        directory.complete()
    click.echo(json.dumps(tree, indent=2) if as_json else "\n\n".join(text_of(study) for study in studies))
    if not as_json:
        click.echo("".join(f"\nwritten        {path}" for path in (out, recording) if path is not None))
    if not all(study.converged for study in studies):
        ctx.exit(1)


_OF_LOGS, _OF_NONLINEAR = ("log", "MRCLAM folders"), ("bearing-range", "nonlinear files")
_ALONE = {  # options that only some problems take
    "robot": ("--robot", *_OF_LOGS),
    "noise": ("--odometry-noise", *_OF_LOGS),
    "guess": ("--guess", *_OF_NONLINEAR),
    "optimizer": ("--optimizer", *_OF_NONLINEAR),
}


def _check_options(ctx: click.Context, kinds: Collection[str]) -> None:
    """Refuse options that none of the problems, of these kinds, takes."""
    for name, (flag, kind, what) in _ALONE.items():
        if kind not in kinds and ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise InputError(f"{flag} is for {what} alone, and DATA names none; leave it out")


def _noise(text: str | None) -> OdometryNoise | None:
    """Four positive numbers with commas; None is to be estimated."""
    from scanchain.landmarks.ranges import OdometryNoise

    if text is None:
        return None
    try:
        values = [float(word) for word in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 4 or not all(0.0 < value < 1e3 for value in values):
        raise InputError(f"--odometry-noise is {text!r}; give four positive numbers, as 0.03,0.01,0.05,0.1")
    return OdometryNoise(*values)


def _check_names(studies: Sequence[Study]) -> None:
    """Refuse problems whose files would overwrite each other."""
    from scanchain.landmarks.results import file_stem

    stems = [file_stem(study.name) for study in studies]
    for study, stem in zip(studies, stems, strict=True):
        if stems.count(stem) > 1:
            raise InputError(f"two problems are called {study.name}; rename one, or give each a call of its own")


def _write(directory: Path, data: Sequence[Path], studies: Sequence[Study], tree: dict[str, object]) -> None:
    """Write the estimates and the figures of all solvers."""
    from msgspec.structs import replace

    from scanchain.landmarks.results import write_estimate
    from scanchain.runs.provenance import describe_start

    for study in studies:
        write_estimate(directory, study)
    (directory / "metrics.json").write_text(json.dumps(tree, indent=2) + "\n", encoding="utf-8")
    files = [file for path in data for file in (sorted(path.glob("*.dat")) if path.is_dir() else [path])]
    replace(describe_start(sys.argv, files, ""), complete=True).write(directory / "run.json")
