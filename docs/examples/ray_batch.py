"""A batch on Ray: every log of a folder on some node of a cluster, one row each in batch.parquet."""

import subprocess
from pathlib import Path

import pyarrow.parquet as pq
import ray

import scanchain

Path("logs").mkdir()
for seed in range(2):  # your logs, in a folder that all nodes see
    scanchain.simulate("office", f"logs/office_{seed}.mcap", duration_s=2.0, seed=seed)

ray.init(num_cpus=2, include_dashboard=False)  # a cluster of this machine; elsewhere: ray start --head
address = ray.get_runtime_context().gcs_address  # or auto
batch = ["scanchain", "batch", "logs", "--out", "runs/all", "--rerun", "off", "--ray", address]
subprocess.run(batch, check=True, capture_output=True)  # again: only the logs without a result
ray.shutdown()

table = pq.read_table("runs/all/batch.parquet")
print(table.column("state").to_pylist(), table.column("scans").to_pylist())  # -> ['done', 'done'] [20, 20]
