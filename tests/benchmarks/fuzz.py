"""Reads damaged logs, messages, runs and checkpoints, as many as wanted; prints and keeps what is read badly."""

import tempfile
import time
from pathlib import Path

import numpy as np

from tests.benchmarks.harness import options_of
from tests.support import fuzzing, fuzzing_files, fuzzing_formats, fuzzing_runs


def main():
    options = options_of(__doc__, cache=False, cases=20_000, seed=0, only=KINDS, keep=Path)
    bad = 0
    for name in options.only:
        began, found = time.process_time(), 0
        with tempfile.TemporaryDirectory() as folder:
            for wrong, data in KINDS[name](Path(folder), np.random.default_rng(options.seed), options.cases):
                found += 1
                print(wrong, flush=True)
                if options.keep and data is not None:
                    options.keep.mkdir(parents=True, exist_ok=True)
                    (options.keep / f"{name}_{found}").write_bytes(data)
        print(f"{name}: {options.cases} cases in {time.process_time() - began:.0f} s of CPU, {found} read badly")
        bad += found
    return 1 if bad else 0


def _files(seeds):
    def complaints(folder, rng, cases):
        made = list(seeds(folder))
        for seed in made:
            for name, damaged, wrong in fuzzing.complaints(seed, rng, cases // len(made)):
                yield f"{seed.name}: {name}: {damaged.what}: {wrong}", damaged.data

    return complaints


def _messages(folder, rng, cases):
    for wrong in fuzzing.payload_complaints(folder, rng, cases):
        yield wrong, None


def _of(kinds):
    def complaints(folder, rng, cases):
        for wrong in fuzzing_files.complaints(kinds(folder), rng, cases):
            yield wrong, None

    return complaints


KINDS = {
    "mcap": _files(fuzzing.seeds), "formats": _files(fuzzing_formats.seeds), "real": _files(fuzzing.real_seeds),
    "messages": _messages, "checkpoint": fuzzing_runs.checkpoint_complaints, "run": fuzzing_runs.run_complaints,
    "files": _of(fuzzing_files.kinds), "runs": _of(fuzzing_files.run_kinds),
}  # fmt: skip

if __name__ == "__main__":
    raise SystemExit(main())
