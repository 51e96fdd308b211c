"""NEES of the motions between scans on real logs with a ground truth, and how rough that truth is.

    python -m tests.benchmarks.truth_noise

NEES is that of ``scanchain compare LOG --methods plicp``, mean over the scans: errors of the truth count as ours.
Roughness is the root mean square change of the motion from one scan to the next, forward in mm and of the rotation
in mrad: what the truth has more of than the odometry on the same drive is noise of the truth or of its stamps.
Correlation is that of successive forward errors, -0.5 where the positions of the truth have independent errors.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.__main__ import main as scanchain
from scanchain.evaluation import pair
from scanchain.trajectory import read_tum
from tests.benchmarks.accuracy import DATA

MOCAP = "--gt /vrpn_client_node/jackal/pose"
LOGS = {
    "3d/kitti_0001_first54.mcap": "",
    "3d/pandaset_002_sweeps30to55.mcap": "--topic /pandar64/points",
    "2d/mocap_room_1.bag": MOCAP,
    "2d/mocap_room_2.bag": MOCAP,
}
GAP_S = 0.2  # largest gap of the truth that is interpolated


def line(log: Path, flags: str, folder: Path) -> str:
    """A row of the table."""
    with contextlib.redirect_stdout(io.StringIO()):
        scanchain(["compare", str(log), "--methods", "plicp", *flags.split(), "--out", str(folder)])
    (row,) = json.loads((folder / "table.json").read_text())["rows"]
    estimate = read_tum(folder / "methods/plicp/trajectory.tum")
    pairs = pair(estimate, read_tum(folder / "ground_truth.tum"), gap_s=GAP_S)
    follows = np.diff(pairs.places) == 1
    true, ours = (
        lie.log(lie.between(poses[:-1], poses[1:]))[follows] for poses in (pairs.reference, pairs.estimate)
    )
    error = (ours - true)[:, 0]
    correlation = np.corrcoef(error[:-1], error[1:])[0, 1]
    rotation = slice(true.shape[1] // 2, None)  # planar ones are lifted to SE(3) in TUM files
    rough = " | ".join(
        f"{1e3 * _roughness(each[:, axes]):.1f}" for axes in (slice(1), rotation) for each in (true, ours)
    )
    return f"| {log.stem} | {row['figures']['nees']:.1f} | {rough} | {correlation:.2f} |"


def _roughness(motions: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(np.diff(motions, axis=0) ** 2, axis=1))))


def main() -> None:
    print("| log | NEES | forward, truth | ours, mm | rotation, truth | ours, mrad | correlation |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, flags) in enumerate(LOGS.items()):
            if (DATA / name).exists():
                print(line(DATA / name, flags, Path(folder) / str(number)), flush=True)
            else:
                print(f"| {name} | absent |", flush=True)


if __name__ == "__main__":
    main()
