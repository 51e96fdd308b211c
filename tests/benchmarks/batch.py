"""How a batch grows with its workers, or with the nodes of a cluster.

    python -m tests.benchmarks.batch [LOGS] [--ray] [--seconds 30]

The same logs with one worker and with two, in turn, three rounds; the ratio of the medians. With --ray they are
nodes of a local Ray cluster, of one core each, that are there before the clock starts. On an idle machine.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from time import perf_counter

from scanchain.batch.batch import Batch, run_batch
from scanchain.runs.job import Progress
from scanchain.simulation import simulate

ROUNDS = 3


def timed(logs: Sequence[Path], out: Path, workers: int, *, on_ray: bool) -> float:
    """Seconds that the batch takes with so many workers or nodes."""
    arguments = ("--rerun", "off")
    if not on_ray:
        began = perf_counter()
        batched = run_batch(Batch(logs, out, arguments=arguments, workers=workers), Progress())
    else:
        from scanchain.batch.cluster import on_cluster

        with nodes(workers) as address:
            work = on_cluster(address)
            began = perf_counter()
            batched = run_batch(Batch(logs, out, arguments=arguments), Progress(), work)
    assert batched.failures == "", batched.summary
    return perf_counter() - began


@contextmanager
def nodes(count: int) -> Iterator[str]:
    """Address of a cluster of so many nodes of one core beside its head, which has none."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(count):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    try:
        yield cluster.address
    finally:
        cluster.shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=int, nargs="?", default=8)
    parser.add_argument("--ray", action="store_true", help="nodes of a cluster instead of workers")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of a log, default: %(default)s")
    arguments = parser.parse_args()
    what = "nodes" if arguments.ray else "workers"
    with TemporaryDirectory() as folder:
        logs = tuple(Path(folder) / f"log_{k}.mcap" for k in range(arguments.logs))
        for seed, log in enumerate(logs):
            simulate("office", log, duration_s=arguments.seconds, seed=seed)
        timed(logs[:1], Path(folder) / "warm", 1, on_ray=arguments.ray)
        took_s: dict[int, list[float]] = {1: [], 2: []}
        for turn in range(ROUNDS):
            for count, times_s in took_s.items():
                times_s.append(timed(logs, Path(folder) / f"out_{turn}_{count}", count, on_ray=arguments.ray))
                print(f"{count} {what}: {times_s[-1]:.1f} s", flush=True)
    faster = median(took_s[1]) / median(took_s[2])
    print(f"{arguments.logs} logs: {faster:.2f} x as fast with two {what} (medians), efficiency {faster / 2:.2f}")


if __name__ == "__main__":
    main()
