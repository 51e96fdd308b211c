"""A batch on a Ray cluster of two nodes, one of which dies half-way."""

import os

import pyarrow.parquet as pq
import pytest

from scanchain.batch.batch import Batch, on_cluster, run_batch
from scanchain.batch.task import attempt
from tests.support import made
from tests.support.scenes import ROOT

pytest.importorskip("ray", reason="the extra cluster is not installed")


class Watching:
    """Kills a node once so many logs are done."""

    def __init__(self, after, kill):
        self.after, self.kill = after, kill

    def say(self, line):
        pass

    def count(self, done, total):
        if done == self.after:
            self.kill()


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs a local cluster")
def test_of_two_nodes_one_dies_and_nothing_is_lost(tmp_path, monkeypatch):
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(ROOT), prepend=os.pathsep)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    for name, value in (("period_ms", 1000), ("timeout_ms", 2000), ("failure_threshold", 2)):
        monkeypatch.setenv(f"RAY_health_check_{name}", str(value))  # a dead node is noticed within seconds
    logs = [made.log("office", seconds=2, seed=seed) for seed in range(6)]
    options = {"num_cpus": 1, "object_store_memory": 80 << 20}
    cluster = Cluster(initialize_head=True, head_node_args={**options, "include_dashboard": False})
    try:
        doomed = cluster.add_node(**options)
        cluster.wait_for_nodes()
        work = on_cluster(cluster.address, attempt)
        watching = Watching(2, lambda: cluster.remove_node(doomed, allow_graceful=False))
        batched = run_batch(Batch(tuple(logs), tmp_path / "out", arguments=("--rerun", "off")), watching, work)
    finally:
        cluster.shutdown()
    assert batched.failures == "", batched.summary
    table = pq.read_table(tmp_path / "out" / "batch.parquet").to_pylist()
    assert [row["state"] for row in table] == ["done"] * 6 and [row["scans"] for row in table] == [20] * 6
    assert len(list((tmp_path / "out").glob("*/metrics.json"))) == 6
