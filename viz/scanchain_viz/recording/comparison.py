"""The recording of a comparison: trajectories and maps of all methods on one timeline, to toggle one by one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import rerun as rr
import rerun.blueprint as rrb

from scanchain.comparison.results import MAP_FILE, SCANS_FILE, TRUTH_FILE, method_folder
from scanchain.comparison.table import Table, read_table
from scanchain.maps import read_ply
from scanchain.trajectory import read_tum
from scanchain_viz.colors import rgb
from scanchain_viz.pictures.trajectories import DrawnTrajectory, trajectories_of_comparison
from scanchain_viz.recording import drawing, entities
from scanchain_viz.recording.blueprint import scene, up_to_now, whole_log, with_panels
from scanchain_viz.recording.drawing import Message, Times
from scanchain_viz.recording.sinks import write_recording

RECORDING_FILE = "compare.rrd"
_MAP_POINTS = 60_000
_HEADROOM = 1.2  # factor over the 99th percentile at which a plot ends
_PLOTS = {"error": "position error [m]", "time": "time of a scan [ms]"}


def record_comparison(directory: Path) -> None:
    """Write compare.rrd into a comparison's directory. Raises OSError."""
    table, trajectories = read_table(directory), trajectories_of_comparison(directory)
    name, messages = Path(table.log.split(", ")[0]).name, _messages(directory, trajectories, _stamps(directory))
    layout = _blueprint(trajectories, table)
    write_recording(directory / RECORDING_FILE, name, table.dimension, layout, messages, kind="comparison")


def _messages(directory: Path, trajectories: Sequence[DrawnTrajectory], stamps_ns: np.ndarray) -> list[Message]:
    messages: list[Message] = []
    truth_file = directory / TRUTH_FILE
    if truth_file.exists():
        path = drawing.positions(read_tum(truth_file).poses)
        messages.append(Message(entities.GROUND_TRUTH, drawing.lines([path], entities.WHITE, 0.75)))
    for trajectory in trajectories:
        messages += _of(trajectory, method_folder(directory, trajectory.name) / MAP_FILE, stamps_ns)
    return messages


def _of(trajectory: DrawnTrajectory, map_file: Path, stamps_ns: np.ndarray) -> list[Message]:
    """The trajectory in segments, the lidar on it, the map, and the plots."""
    name = rr.escape_entity_path_part(trajectory.name)
    color, positions = rgb(trajectory.color), trajectory.positions.astype(np.float32)
    times = Times(np.arange(len(positions)), stamps_ns[: len(positions)])
    before = np.concatenate([positions[:1], positions[:-1]])
    strips = rr.LineStrips3D.columns(strips=np.stack([before, positions], axis=1))
    messages = [
        Message(f"world/{name}/trajectory", drawing.lines(color=color, radius=1.5)),
        Message(f"world/{name}/trajectory", strips, times),
        Message(f"world/{name}/lidar", drawing.dots(color=color, radius=5.0)),
        Message(
            f"world/{name}/lidar", rr.Points3D.columns(positions=positions).partition([1] * len(positions)), times
        ),
    ]
    if map_file.exists():
        points = drawing.at_most(read_ply(map_file), _MAP_POINTS)
        red, green, blue = ((value + shade) // 2 for value, shade in zip(color, entities.GRAY, strict=True))
        messages.append(Message(f"world/{name}/map", drawing.dots(points, (red, green, blue), 0.5)))
    for plot, values in _series(trajectory).items():
        known = np.isfinite(values)
        if known.any():
            series = rr.SeriesLines(colors=[color], names=[trajectory.name], widths=[1.0])
            messages.append(Message(f"plots/{plot}/{name}", series))
            columns = rr.Scalars.columns(scalars=values[known])
            messages.append(Message(f"plots/{plot}/{name}", columns, times[known]))
    return messages


def _series(trajectory: DrawnTrajectory) -> dict[str, np.ndarray]:
    """Scan by scan, by plot."""
    return {"error": trajectory.error_m, "time": 1e3 * trajectory.seconds}


def _blueprint(trajectories: Sequence[DrawnTrajectory], table: Table) -> rrb.Blueprint:
    """Trajectories above, maps of all but the first method hidden; plots below, one legend for both."""
    names = [rr.escape_entity_path_part(trajectory.name) for trajectory in trajectories]
    overrides: dict[Any, Any] = {f"world/{name}/trajectory": [up_to_now()] for name in names}
    overrides |= {f"world/{name}/map": [rrb.EntityBehavior(visible=False)] for name in names[1:]}
    seen = trajectories[0].positions if trajectories else None
    world = scene("trajectories and maps", table.dimension, seen, overrides)
    below = rrb.Horizontal(*_plots(trajectories))
    return with_panels(rrb.Vertical(world, below, row_shares=[2, 1]), scans=table.scans, has_toggles=True)


def _plots(trajectories: Sequence[DrawnTrajectory]) -> list[rrb.TimeSeriesView]:
    """Plots of the known values, scaled so that a single slow scan leaves the rest visible."""
    views = []
    for plot, name in _PLOTS.items():
        values = np.concatenate([np.empty(0), *(_series(trajectory)[plot] for trajectory in trajectories)])
        if np.isfinite(values).any():
            highest = _HEADROOM * float(np.nanpercentile(values, 99.0))
            legend = rrb.PlotLegend(rrb.Corner2D.RightTop, visible=plot == "time")
            axes = {"axis_x": whole_log(), "axis_y": rrb.ScalarAxis(range=(0.0, highest))}
            views.append(rrb.TimeSeriesView(origin=f"plots/{plot}", name=name, plot_legend=legend, **axes))
    return views


def _stamps(directory: Path) -> np.ndarray:
    """(N,) of all scans, from the method with the most."""
    table = pq.read_table(directory / SCANS_FILE, columns=["index", "stamp_ns"])
    indices, first = np.unique(table["index"].to_numpy(), return_index=True)
    return table["stamp_ns"].to_numpy()[first] if len(indices) else np.empty(0, np.int64)
