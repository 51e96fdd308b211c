"""Kills runs at random moments and checks that what is left opens and that they go on to the same result.

Logs are LOG END_S ..., each with the second at which it is cut.
"""

import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.benchmarks.harness import options_of
from tests.support.killing import kill_at_random, start
from tests.support.scenes import DATA

LOGS = ("2d/intel.mcap", "300"), ("3d/kitti_0005_first60.mcap", "3")
LIVELY = ("--checkpoint", "0.2")


def main():
    options = options_of(__doc__, "logs", cache=False, kills=50, seed=1, logs=[])
    named = list(zip(options.logs[::2], options.logs[1::2], strict=True))
    for log, end_s in named or [(DATA / name, end_s) for name, end_s in LOGS]:
        words = (*LIVELY, "--end", end_s)
        with tempfile.TemporaryDirectory() as name:
            folder, whole = Path(name), Path(name) / "whole"
            assert start(log, Path(name) / "warm", *words).wait() == 0
            began = time.perf_counter()
            assert start(log, whole, *words).wait() == 0
            longest_s = time.perf_counter() - began
            print(f"{log} {' '.join(words)}: {longest_s:.1f} s undisturbed; seed {options.seed}", flush=True)
            places = Counter()
            killed = kill_at_random(
                log, words, folder, whole, kills=options.kills, seed=options.seed, longest_s=longest_s
            )
            for number, each in enumerate(killed, start=1):
                places[each.where] += 1
                print(f"{number:3d}  after {each.after_s:6.2f} s, {each.steps:5d} steps, {each.where}", flush=True)
            done = sum(path.is_dir() and "partial" not in path.name for path in folder.glob("run_*"))
            print(f"{options.kills} kills, {done} runs completed, each as if undisturbed; {dict(places)}")


if __name__ == "__main__":
    main()
