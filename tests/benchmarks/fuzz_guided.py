"""Looks for files that are read badly by what code they reach, with atheris (pip install atheris).

python -m tests.benchmarks.fuzz_guided CORPUS -max_total_time=300 [any flag of libFuzzer]
"""

import os
import sys
import tempfile
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"  # instrumented Python does not compile

import atheris

with atheris.instrument_imports(include=["scanchain.logs"]):
    from tests.support import fuzzing


def main():
    corpus = Path(sys.argv[1])
    corpus.mkdir(parents=True, exist_ok=True)
    list(fuzzing.seeds(corpus))
    damaged = Path(tempfile.mkdtemp()) / "damaged.mcap"

    def read(data):
        damaged.write_bytes(b"\x89MCAP0\r\n" + data[8:])
        fuzzing.read(damaged)

    limits = ["-timeout=5", "-rss_limit_mb=8000", "-max_len=30000"]
    atheris.Setup([*sys.argv, *limits], read)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
