"""``scanchain evaluate``: metrics of a trajectory against ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from scanchain.commands import options
from scanchain.commands.options import PATH
from scanchain.errors import InputError, folded
from scanchain.files import json_text

if TYPE_CHECKING:
    from scanchain.evaluation.metrics import Results


@click.command()
@click.argument("files", metavar="EST.tum... [GT]", nargs=-1, required=True, type=PATH)
@click.option("--gt", metavar="FILE", type=PATH, help="Ground truth. [default: the last of two files or more]")
@options.relations
@click.option(
    "--align",
    type=click.Choice(["rigid", "first", "none"]),
    default="rigid",
    help="Alignment of the estimate to the ground truth for the ATE.",
)
@click.option("--scale", is_flag=True, help="Scale the estimate to fit, too: with --align rigid, Sim(3).")
@click.option(
    "--time-offset",
    type=lambda text: text if text == "auto" else float(text),
    default=0.0,
    metavar="auto|SECONDS",
    help="Seconds to add to the stamps of EST; auto finds those of the least ATE within 1 s.",
)
@options.max_gap
@click.option(
    "--rpe",
    default="1pose,1s,10m,100m",
    metavar="LIST",
    help="Intervals of the RPE in poses, seconds or meters, comma-separated.",
)
@click.option(
    "--kitti",
    is_flag=True,
    help="All files are KITTI's, 12 numbers a line; poses pair line by line, so that their numbers are equal.",
)
@click.option("--png", metavar="FILE", type=PATH, help="Draw the estimates, aligned, over the ground truth.")
@options.force("an existing picture")
@click.option("--verbose", is_flag=True, help="Print the definitions of the figures, too; --json holds them.")
@options.as_json
def evaluate(
    files: tuple[Path, ...],
    gt: Path | None,
    relations: Path | None,
    kitti: bool,
    png: Path | None,
    force: bool,
    verbose: bool,
    as_json: bool,
    **given: Any,
) -> None:
    """Print ATE, RPE, KITTI metric and error over relations; several EST as a table.

    Give the ground truth, or --relations, or both. GT is a TUM file, interpolated at the stamps of EST (positions
    linear, rotations by SLERP, nothing extrapolated), or a KITTI file with one row per pose of EST. A run
    directory stands for its trajectory.tum.

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
    if kitti and given["time_offset"]:
        raise InputError("--time-offset is for files with stamps; KITTI's have none")
    if png is not None and gt is None:
        raise InputError("--png draws over a ground truth; give GT")
    if png is not None:
        options.check_output(png, force=force, endings=(".png",))
    evaluated = {str(path): _evaluated(path, gt, relations, kitti, given) for path in files}
    for name, results in evaluated.items():
        for warning in results.warnings:
            click.echo(f"warning: {f'{name}: ' * (len(evaluated) > 1)}{warning}", err=True)
    if png is not None:
        from scanchain_viz.pictures.maps import draw_evaluated

        draw_evaluated(png, {name: (each.aligned, each.reference) for name, each in evaluated.items()})
    trees = {name: _tree(results) for name, results in evaluated.items()}
    tree = trees if len(trees) > 1 else trees.popitem()[1]
    click.echo(json_text(tree) if as_json else _text(evaluated, is_verbose=verbose))
    if png is not None and not as_json:
        click.echo(f"written {png}")


def _evaluated(
    estimate: Path, gt: Path | None, relations: Path | None, kitti: bool, given: dict[str, Any]
) -> Results:
    """Every metric of a file, or of a run directory."""
    from scanchain.evaluation import TruthFile, read_relations, read_truth, relation_error
    from scanchain.evaluation.metrics import Results, evaluate
    from scanchain.trajectory import read_kitti, read_tum

    trajectory = read_kitti(estimate) if kitti else read_tum(estimate)
    results = Results({}, {})
    if gt is not None:
        truth = TruthFile(gt, read_kitti(gt), has_stamps=False) if kitti else read_truth(gt)
        results = evaluate(trajectory, truth.at(trajectory.stamps_ns), **given)
    if relations is not None:
        results.found["relations"] = relation_error(trajectory, read_relations(relations))
    return results


def _text(evaluated: dict[str, Results], *, is_verbose: bool) -> str:
    definitions = dict.fromkeys(
        each.definition for results in evaluated.values() for each in results.found.values()
    )
    lines = _figures(*evaluated.values()) if len(evaluated) == 1 else _table(evaluated)
    return folded("\n".join([*lines, *(definitions if is_verbose else ())]))


def _figures(results: Results) -> Iterator[str]:
    """Statistics of one estimate, one per row, in meters and degrees, followed by the other figures."""
    from scanchain.evaluation.errors import Metric

    if results.pairing:
        yield f"paired {results.pairing}"
    if results.time_offset_s:
        yield f"time offset {results.time_offset_s:+.4f} s added to the stamps of the estimate"
    if results.scale != 1.0:
        yield f"scale {results.scale:.6g} put on the positions of the estimate (Umeyama 1991)"
    errors = {name: error for name, error in results.found.items() if isinstance(error, Metric)}
    heads = [name.replace("rpe", "RPE").replace("ate", "ATE").replace("_", " ") for name in errors]
    yield " " * 6 + "".join(f"{head:>18}" for head in heads)
    yield " " * 6 + f"{'m':>9}{'deg':>9}" * len(heads)
    for name, field_name in _STATISTICS:
        pairs = ((each.translation_m, each.rotation_rad.degrees) for each in errors.values())
        figures = (getattr(each, field_name) for pair in pairs for each in pair)
        yield f"{name:<6}" + "".join(f" {figure:8.4f}" for figure in figures)
    yield from _other_figures(results)


def _other_figures(results: Results) -> Iterator[str]:
    """Figures other than statistics of pose or motion errors."""
    from scanchain.evaluation.errors import KittiError, RelationError

    if "ate" in results.found and (share := results.ate.share_of_path) is not None:
        yield f"ATE is {100.0 * share:.3f} % of the path of {results.ate.path_length_m:.1f} m"
    if results.start_m is not None and results.after_start is not None:
        after_m = results.after_start.translation_m.rmse
        yield f"start: first motion off by {results.start_m:.4f} m; ATE from the second pose on {after_m:.4f} m"
    yield from (each.summary for each in results.found.values() if isinstance(each, RelationError | KittiError))
    yield from (f"not computed: {reason}" for reason in results.missing.values())


def _table(evaluated: dict[str, Results]) -> list[str]:
    """Table with one row per estimate."""
    computed = dict.fromkeys(key for each in evaluated.values() for key in (*each.found, *each.missing))
    keys = sorted(computed, key=lambda key: key in _FIGURES)
    units, figures = zip(*(_FIGURES.get(key, _RMSE) for key in keys), strict=True)
    rows = [["estimate", "paired", "offset s", "scale", *(key.replace("_", " ") for key in keys)]]
    rows.append([*[""] * 4, *units])
    for name, each in evaluated.items():
        row = [name, f"{len(each.aligned):,}", f"{each.time_offset_s:.4f}", f"{each.scale:.5g}"]
        for key, figure in zip(keys, figures, strict=True):
            row.append(f"{figure(each.found[key]):.4f}" if key in each.found else "-")
        rows.append(row)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]


_STATISTICS = tuple((name, {"min": "minimum", "max": "maximum"}.get(name, name)) for name in
    ("rmse", "mean", "median", "std", "min", "max"))  # fmt: skip
_RMSE = ("rmse m", lambda error: error.translation_m.rmse)
_FIGURES = {  # unit and value that the table shows of a metric; the RMSE of all others
    "kitti": ("%", lambda error: 100.0 * error.translation_share),
    "relations": ("mean m", lambda error: error.translation_m.mean),
}


def _tree(results: Results) -> dict[str, object]:
    """The figures for JSON, without the arrays they are computed from."""
    import numpy as np

    tree: dict[str, object] = {}
    for name, result in results.found.items():
        values = ((field.name, getattr(result, field.name)) for field in fields(result))
        tree[name] = {key: value for key, value in values if not isinstance(value, np.ndarray)}
    tree |= dict.fromkeys(results.missing)
    tree |= {} if results.start_m is None else {"start_m": results.start_m}
    tree |= {"time_offset_s": results.time_offset_s} if results.time_offset_s else {}
    return tree | ({"scale": results.scale} if results.scale != 1.0 else {})
