"""How a batch grows with its workers: ``python -m tests.benchmarks.batch [LOGS]``.

The same logs with one worker and with two, in turn, three rounds; the ratio of the medians. On an idle machine.
"""

import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

from scanchain.batch.batch import Batch, run_batch
from scanchain.simulation import simulate

ROUNDS = 3


class Silence:
    def say(self, line):
        pass

    def count(self, done, total):
        pass


def timed(logs, out, workers):
    began = perf_counter()
    batched = run_batch(Batch(logs, out, arguments=("--rerun", "off"), workers=workers), Silence())
    assert batched.failures == "", batched.summary
    return perf_counter() - began


def main(count):
    with TemporaryDirectory() as folder:
        logs = tuple(Path(folder) / f"log_{k}.mcap" for k in range(count))
        for seed, log in enumerate(logs):
            simulate("office", log, duration_s=30.0, seed=seed)
        timed(logs[:1], Path(folder) / "warm", 1)
        took_s = {1: [], 2: []}
        for turn in range(ROUNDS):
            for workers in took_s:
                took_s[workers].append(timed(logs, Path(folder) / f"out_{turn}_{workers}", workers))
                print(f"{workers} workers: {took_s[workers][-1]:.1f} s", flush=True)
    print(f"{count} logs: {median(took_s[1]) / median(took_s[2]):.2f} x as fast with two workers (medians)")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 8)
