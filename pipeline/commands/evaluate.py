"""``scanchain evaluate``: metrics of a trajectory against ground truth."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

import click

from scanchain.commands.options import OnceCommand, max_gap_option
from scanchain.errors import InputError

if TYPE_CHECKING:
    from scanchain.evaluation.metrics import Results

_PATH = click.Path(path_type=Path)


@click.command(cls=OnceCommand)
@click.argument("estimate", metavar="EST.tum", type=_PATH)
@click.argument("reference", metavar="[GT]", required=False, type=_PATH)
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
@max_gap_option
@click.option(
    "--rpe",
    default="1pose,1s,10m,100m",
    show_default=True,
    metavar="LIST",
    help="Intervals of the RPE in poses, seconds or meters, comma-separated.",
)
@click.option("--kitti", is_flag=True, help="Both files are KITTI's, 12 numbers a line; poses pair line by line.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON.")
def evaluate(
    estimate: Path,
    reference: Path | None,
    relations: Path | None,
    align: str,
    max_gap: float | None,
    rpe: str,
    kitti: bool,
    as_json: bool,
) -> None:
    """Print ATE, RPE, KITTI metric and error over relations, each with its definition.

    Give the ground truth, or --relations, or both. GT is a TUM file, interpolated at the stamps of EST (positions
    linear, rotations by SLERP, nothing extrapolated), or a KITTI file with one row a pose of EST.

    \b
    Examples:
      scanchain evaluate runs/log/trajectory.tum truth.tum
      scanchain evaluate runs/intel/trajectory.tum --relations intel.relations
      scanchain evaluate runs/log/trajectory.tum truth.tum --align first --rpe 5s,50m --json
    """
    from scanchain.evaluation import read_relations, read_truth, relation_error
    from scanchain.evaluation.metrics import Results
    from scanchain.evaluation.metrics import evaluate as evaluate_poses
    from scanchain.trajectory import read_kitti, read_tum

    if reference is None and relations is None:
        raise InputError("nothing to compare with; give GT (a TUM or KITTI file) or --relations FILE")
    trajectory = read_kitti(estimate) if kitti else read_tum(estimate)
    results = Results({}, {})
    if reference is not None:
        truth = read_kitti(reference) if kitti else read_truth(reference).at(trajectory.stamps_ns)
        results = evaluate_poses(trajectory, truth, align=align, max_gap_s=max_gap, rpe=rpe, source="--rpe")
    if relations is not None:
        results.found["relations"] = relation_error(trajectory, read_relations(relations))
    for warning in results.warnings:
        click.echo(f"warning: {warning}", err=True)
    click.echo(_json(results) if as_json else _text(results))


def _text(results: Results) -> str:
    lines = [f"paired {results.pairing}"] if results.pairing else []
    lines += [f"{result.summary}\n  {result.definition}" for result in results.found.values()]
    return "\n".join([*lines, *(f"not computed: {reason}" for reason in results.missing.values())])


def _json(results: Results) -> str:
    """The figures without the arrays behind them."""
    tree = {name: _figures(result) for name, result in results.found.items()}
    return json.dumps(tree | dict.fromkeys(results.missing), indent=2)


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
