"""``scanchain landmarks``: solves landmark SLAM problems, and compares linear solvers on them."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from scanchain.commands import options
from scanchain.commands.options import PATH
from scanchain.errors import InputError, folded
from scanchain.files import json_text, write_json

if TYPE_CHECKING:
    from scanchain.landmarks.ranges import OdometryNoise
    from scanchain.landmarks.study import Study


_OF_LOGS, _OF_NONLINEAR = ("log", "MRCLAM folders"), ("bearing-range", "nonlinear files")
_ALONE = {  # options that apply to one kind of problem only
    "robots": ("--robot", *_OF_LOGS),
    "noise": ("--odometry-noise", *_OF_LOGS),
    "ignore_barcodes": ("--ignore-barcodes", *_OF_LOGS),
    "guess": ("--guess", *_OF_NONLINEAR),
    "optimizer": ("--optimizer", *_OF_NONLINEAR),
}


@click.command()
@click.argument("data", metavar="DATA...", nargs=-1, required=True, type=PATH)
@options.out()
@click.option(
    "--methods",
    "--method",
    "methods",
    default="schur",
    metavar="NAME,...",
    help="Linear solvers: one to solve with, several (or all) to compare.",
)
@click.option(
    "--repeat",
    "repeats",
    type=click.IntRange(1, 1000),
    default=3,
    help="Timed repetitions; the median is reported.",
)
@click.option(
    "--robot",
    "robots",
    default="1",
    metavar="N,...",
    help="Robots of an MRCLAM folder, or all; several are estimated in one problem, as they see each other.",
)
@click.option(
    "--odometry-noise",
    "noise",
    metavar="FORWARD,SIDEWAYS,DRIFT,TURN",
    help="Standard deviations of an MRCLAM robot: m, m, rad per meter; rad per radian. [default: estimated]",
)
@click.option(
    "--ignore-barcodes",
    is_flag=True,
    help="Of an MRCLAM log, find which landmark a sighting is of; barcodes only tell robots from landmarks.",
)
@click.option(
    "--guess",
    type=click.Choice(["odometry", "disturbed", "origin"]),
    default="odometry",
    help="Initial guess of a nonlinear file: odometry, disturbed by 1 m and 0.5 rad, or landmarks at the origin.",
)
@click.option(
    "--optimizer",
    type=click.Choice(["levenberg-marquardt", "gauss-newton", "gradient-descent"]),
    default="levenberg-marquardt",
    help="Optimizer for a nonlinear file.",
)
@click.option("--recording", metavar="FILE.rrd", type=PATH, help="Record before and after for rerun.")
@options.force("DIR if it is the result of an earlier run")
@options.as_json
def landmarks(
    data: tuple[Path, ...],
    out: Path,
    methods: str,
    robots: str,
    noise: str | None,
    recording: Path | None,
    force: bool,
    as_json: bool,
    **more: Any,
) -> int:
    """Solve landmark SLAM problems, and compare linear solvers on them.

    DATA is an npz file with a linear problem or with bearing and range measurements, or a folder of the UTIAS
    MRCLAM data sets, of which the log of one robot is used, or of several together. Estimates, pictures and
    report.html go to DIR.

    Methods: default, pinv (below 3,000 unknowns), lu, lu_colamd, qr, qr_colamd, cholesky, schur, or all of them.
    The log of a robot is always estimated by schur; the others are compared on its linear system.

    \b
    Examples:
      scanchain landmarks 2d_linear.npz --out runs/linear
      scanchain landmarks 2d_linear.npz 2d_linear_loop.npz --methods all --out runs/solvers
      scanchain landmarks 2d_nonlinear.npz --guess origin --methods cholesky,schur --out runs/nonlinear
      scanchain landmarks 2d_nonlinear.npz --optimizer gauss-newton --out runs/gn --recording gn.rrd
      scanchain landmarks MRCLAM_Dataset6 --robot 1 --out runs/mrclam --json
      scanchain landmarks MRCLAM_Dataset6 --robot all --out runs/together
      scanchain landmarks MRCLAM_Dataset6 --ignore-barcodes --out runs/anonymous
    """
    from scanchain.clock import announcing_compilation
    from scanchain.commands.terminal import Terminal
    from scanchain.landmarks.files import read_landmark_data
    from scanchain.landmarks.solvers import parse_methods
    from scanchain.landmarks.study import Options, study_file, study_log, text_of, tree_of, write_estimate
    from scanchain.runs.directory import RunDirectory
    from scanchain_viz.report.problems import write_report

    chosen = Options(parse_methods(methods), robots=_robots(robots), noise=_noise(noise), **more)
    problems = [path if path.is_dir() else read_landmark_data(path) for path in data]
    _check_options({"log" if isinstance(each, Path) else each.kind for each in problems})
    if recording is not None:
        options.check_output(recording, force=force, endings=(".rrd",))
    files = [file for path in data for file in (sorted(path.glob("*.dat")) if path.is_dir() else [path])]
    directory = RunDirectory(out, force=force, sources=files, command=sys.argv)
    with directory, Terminal("problems") as terminal:
        directory.begin()
        with announcing_compilation(terminal.say):
            studies = [
                study_log(each, chosen) if isinstance(each, Path) else study_file(each, chosen)
                for each in problems
            ]
        _check_names(studies)
        for study in studies:
            write_estimate(directory.path, study)
        tree = {"problems": [tree_of(study) for study in studies]}
        write_json(directory.path / "metrics.json", tree)
        directory.end()
        write_report(directory.path, studies)
        if recording is not None:
            from scanchain_viz.recording.results import record_landmarks

            record_landmarks(studies, recording)
        directory.complete()
    click.echo(json_text(tree) if as_json else folded("\n\n".join(map(text_of, studies))))
    if not as_json:
        click.echo("".join(f"\nwritten        {path}" for path in (out, recording) if path is not None))
    return int(not all(study.converged for study in studies))


def _check_options(kinds: Collection[str]) -> None:
    """Refuse options that apply to none of these kinds of problems."""
    ctx = click.get_current_context()
    for name, (flag, kind, what) in _ALONE.items():
        if kind not in kinds and ctx.get_parameter_source(name) is ParameterSource.COMMANDLINE:
            raise InputError(f"{flag} is for {what} alone, and DATA names none; leave it out")


def _robots(text: str) -> tuple[int, ...]:
    """Numbers of robots, none for all."""
    if text == "all":
        return ()
    names = text.split(",")
    if not all(name.strip().isdecimal() for name in names) or len(set(map(int, names))) < len(names):
        raise InputError(f"--robot is {text!r}; give a number, several as 1,2,5, or all")
    return tuple(map(int, names))


def _noise(text: str | None) -> OdometryNoise | None:
    from scanchain.landmarks.ranges import OdometryNoise

    if text is None:
        return None
    wrong = f"--odometry-noise is {text!r}; give four positive numbers, as 0.03,0.01,0.05,0.1"
    values = options.numbers(text, (4,), wrong)
    if not all(0.0 < value < 1e3 for value in values):
        raise InputError(wrong)
    return OdometryNoise(*values)


def _check_names(studies: Sequence[Study]) -> None:
    """Refuse problems whose files would overwrite each other."""
    from scanchain.landmarks.study import file_stem

    stems = [file_stem(study.name) for study in studies]
    for study, stem in zip(studies, stems, strict=True):
        if stems.count(stem) > 1:
            raise InputError(f"two problems are called {study.name}; rename one, or give each a call of its own")
