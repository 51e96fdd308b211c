"""``scanchain evaluate``: metrics of a trajectory against ground truth."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands.options import check_output, max_gap_option
from scanchain.errors import InputError

if TYPE_CHECKING:
    from scanchain.evaluation.metrics import Result, Results

_PATH = click.Path(path_type=Path)


class _Offset(click.ParamType):
    name = "offset"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        return value if value == "auto" else click.FLOAT.convert(value, param, ctx)


@click.command()
@click.argument("files", metavar="EST.tum... [GT]", nargs=-1, required=True, type=_PATH)
@click.option("--gt", metavar="FILE", type=_PATH, help="Ground truth. [default: the last of two files or more]")
@click.option(
    "--relations", metavar="FILE", type=_PATH, help="Manually verified relative poses (Kümmerle et al. 2009)."
)
@click.option(
    "--align",
    type=click.Choice(["rigid", "first", "none"]),
    default="rigid",
    show_default=True,
    help="Alignment of the estimate to the ground truth for the ATE.",
)
@click.option("--scale", is_flag=True, help="Scale the estimate to fit, too: with --align rigid, Sim(3).")
@click.option(
    "--time-offset",
    type=_Offset(),
    default=0.0,
    metavar="auto|SECONDS",
    help="Seconds to add to the stamps of EST; auto finds those of the least ATE within 1 s.",
)
@max_gap_option
@click.option(
    "--rpe",
    default="1pose,1s,10m,100m",
    show_default=True,
    metavar="LIST",
    help="Intervals of the RPE in poses, seconds or meters, comma-separated.",
)
@click.option("--kitti", is_flag=True, help="All files are KITTI's, 12 numbers a line; poses pair line by line.")
@click.option("--png", metavar="FILE", type=_PATH, help="Draw the estimates, aligned, over the ground truth.")
@click.option("--force", is_flag=True, help="Replace an existing picture.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def evaluate(
    files: tuple[Path, ...],
    gt: Path | None,
    relations: Path | None,
    kitti: bool,
    png: Path | None,
    force: bool,
    as_json: bool,
    **options: Any,
) -> None:
    """Print ATE, RPE, KITTI metric and error over relations, each with its definition; several EST as a table.

    Give the ground truth, or --relations, or both. GT is a TUM file, interpolated at the stamps of EST (positions
    linear, rotations by SLERP, nothing extrapolated), or a KITTI file with one row a pose of EST. A run directory
    stands for its trajectory.tum.

    \b
    Examples:
      scanchain evaluate runs/log/trajectory.tum truth.tum
      scanchain evaluate runs/log kiss.tum other.tum truth.tum --png errors.png
      scanchain evaluate runs/intel --relations intel.relations
      scanchain evaluate runs/log mocap.tum --time-offset auto
      scanchain evaluate mono.tum truth.tum --scale --align rigid
      scanchain evaluate runs/log truth.tum --align first --rpe 5s,50m --json
    """
    if gt is None and len(files) > 1:
        files, gt = files[:-1], files[-1]
    if gt is None and relations is None:
        raise InputError("nothing to compare with; give GT (a TUM or KITTI file) or --relations FILE")
    if kitti and options["time_offset"]:
        raise InputError("--time-offset is for files with stamps; KITTI's have none")
    if png is not None and gt is None:
        raise InputError("--png draws over a ground truth; give GT")
    if png is not None:
        check_output(png, force=force, endings=(".png",))
    evaluated = {str(path): _evaluated(path, gt, relations, kitti, options) for path in files}
    for name, results in evaluated.items():
        for warning in results.warnings:
            click.echo(f"warning: {f'{name}: ' * (len(evaluated) > 1)}{warning}", err=True)
    if png is not None:
        from scanchain_viz.pictures.maps import draw_evaluated

        draw_evaluated(png, {name: (each.aligned, each.reference) for name, each in evaluated.items()})
    click.echo((_json if as_json else _text)(evaluated))
    if png is not None and not as_json:
        click.echo(f"written {png}")


def _evaluated(
    estimate: Path, gt: Path | None, relations: Path | None, kitti: bool, options: dict[str, Any]
) -> Results:
    """Every metric of a file, or of the trajectory of a run directory."""
    from scanchain.evaluation import read_relations, read_truth, relation_error
    from scanchain.evaluation.metrics import Results, evaluate
    from scanchain.trajectory import read_kitti, read_tum

    path = estimate / "trajectory.tum" if estimate.is_dir() else estimate
    trajectory = read_kitti(path) if kitti else read_tum(path)
    results = Results({}, {})
    if gt is not None:
        truth = read_kitti(gt) if kitti else read_truth(gt).at(trajectory.stamps_ns)
        results = evaluate(trajectory, truth, source="--rpe", **options)
    if relations is not None:
        results.found["relations"] = relation_error(trajectory, read_relations(relations))
    return results


def _text(evaluated: dict[str, Results]) -> str:
    """All of one estimate, or a table of several."""
    if len(evaluated) > 1:
        return _table(evaluated)
    (results,) = evaluated.values()
    lines = [f"paired {results.pairing}"] if results.pairing else []
    if results.time_offset_s:
        lines.append(f"time offset {results.time_offset_s:+.4f} s added to the stamps of the estimate")
    if results.scale != 1.0:
        lines.append(f"scale {results.scale:.6g} put on the positions of the estimate (Umeyama 1991)")
    lines += [f"{result.summary}\n  {result.definition}" for result in results.found.values()]
    return "\n".join([*lines, *(f"not computed: {reason}" for reason in results.missing.values())])


def _table(evaluated: dict[str, Results]) -> str:
    """A row an estimate, and below it the definitions of its columns."""
    computed = dict.fromkeys(key for each in evaluated.values() for key in (*each.found, *each.missing))
    keys = sorted(computed, key=lambda key: key in ("kitti", "relations"))
    units = ["%" if key == "kitti" else "mean m" if key == "relations" else "rmse m" for key in keys]
    rows = [["estimate", "paired", "offset s", "scale", *(key.replace("_", " ") for key in keys)]]
    rows.append([*[""] * 4, *units])
    for name, each in evaluated.items():
        figures = [_figure(each.found[key]) if key in each.found else "-" for key in keys]
        rows.append([name, f"{len(each.aligned):,}", f"{each.time_offset_s:.4f}", f"{each.scale:.5g}", *figures])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]
    definitions = dict.fromkeys(
        each.definition for results in evaluated.values() for each in results.found.values()
    )
    return "\n".join([*lines, *definitions])


def _figure(result: Result) -> str:
    """The one figure of a metric for a table."""
    from scanchain.evaluation import KittiError, RelationError

    if isinstance(result, KittiError):
        return f"{100.0 * result.translation_share:.4f}"
    return f"{result.translation_m.mean if isinstance(result, RelationError) else result.translation_m.rmse:.4f}"


def _json(evaluated: dict[str, Results]) -> str:
    """The figures of one estimate, those of several by their names."""
    trees = {name: _tree(results) for name, results in evaluated.items()}
    return json.dumps(trees if len(trees) > 1 else trees.popitem()[1], indent=2)


def _tree(results: Results) -> dict[str, object]:
    """The figures without the arrays behind them."""
    tree = {name: _figures(result) for name, result in results.found.items()} | dict.fromkeys(results.missing)
    tree |= {"time_offset_s": results.time_offset_s} if results.time_offset_s else {}
    return tree | ({"scale": results.scale} if results.scale != 1.0 else {})


def _figures(record: object) -> object:
    if is_dataclass(record) and not isinstance(record, type):
        values = {field.name: _figures(getattr(record, field.name)) for field in fields(record)}
        return {name: value for name, value in values.items() if value is not _LEFT_OUT}
    if isinstance(record, tuple):
        return [_figures(item) for item in record]
    if isinstance(record, float):
        return record if isfinite(record) else None
    return record if isinstance(record, int | str | None) else _LEFT_OUT


_LEFT_OUT = object()
