"""Memory of one odometry: ``python -m tests.benchmarks.peak_memory LOG METHOD [SCANS]``.

A process of its own reads the log scan by scan and runs one method. Prints two numbers in MiB: the peak of its
resident memory, interpreter, packages and log reader included, and how much of it came after the first scan.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from scanchain.config import LogConfig
from scanchain.logs import open_log
from scanchain.processes import peak_mib
from tests.benchmarks.contest import create

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, slots=True)
class PeakMemory:
    """Peak of the resident memory of a process, and how much of it came after the first scan; MiB."""

    peak_mib: float
    growth_mib: float


def measure(path: Path, method: str, scans: int) -> PeakMemory | None:
    """The memory of a method, None where it fails or the system does not tell (it does on Linux)."""
    command = [sys.executable, "-m", "tests.benchmarks.peak_memory", str(path.resolve()), method, str(scans)]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if answer.returncode != 0:
        return None
    return PeakMemory(*map(float, answer.stdout.split()[-2:]))


def main() -> None:
    path, method, *count = sys.argv[1:]
    first_mib = 0.0
    log = open_log([Path(path)], LogConfig())
    odometry = create(method, log.T_base_lidar)
    for scan in islice(log.scans(), int(count[0]) if count else None):
        odometry.process(scan)
        first_mib = first_mib or peak_mib()
    print(f"{peak_mib():.1f} {peak_mib() - first_mib:.1f}")


if __name__ == "__main__":
    main()
