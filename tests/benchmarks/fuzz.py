"""Reads damaged logs and messages, as many as wanted, and prints what is read badly.

python -m tests.benchmarks.fuzz --cases 50000 --seed 1 [--keep DIR]
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import fuzzing


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, help="folder for the files that are read badly")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    began, bad = time.perf_counter(), 0
    with tempfile.TemporaryDirectory() as folder:
        seeds = list(fuzzing.seeds(Path(folder)))
        each = options.cases // (2 * len(seeds))
        for seed in seeds:
            for damaged, wrong in fuzzing.file_complaints(seed, rng, each):
                bad += 1
                print(f"{seed.name}: {damaged.what}: {wrong}", flush=True)
                if options.keep:
                    options.keep.mkdir(parents=True, exist_ok=True)
                    (options.keep / f"{bad}.mcap").write_bytes(damaged.data)
        for wrong in fuzzing.payload_complaints(Path(folder), rng, options.cases // 2):
            bad += 1
            print(wrong, flush=True)
    print(f"{options.cases} cases and every cut in {time.perf_counter() - began:.0f} s: {bad} read badly")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
