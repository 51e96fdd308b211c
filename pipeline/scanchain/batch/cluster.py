"""Ray: the tasks of a batch on the machines of a cluster that see the same files."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence

from scanchain.batch.task import Row, Task, attempt
from scanchain.errors import InputError, MissingExtraError

_NODE_LOSSES = 10  # of a task, before it counts as lost


def on_cluster(address: str) -> Callable[[Sequence[Task]], Iterator[Row]]:
    """Worker that runs tasks on a Ray cluster, one core each; those of a machine that dies move to another.

    address : of the cluster's head, or "auto" for the one that this machine belongs to
    Raises MissingExtraError without Ray, InputError where no cluster responds.
    """
    try:
        import ray
    except ImportError:
        raise MissingExtraError("ray", "cluster") from None
    try:
        ray.init(address, ignore_reinit_error=True, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"--ray is {address!r}: {reason}; start a cluster with ray start --head") from None
    remote = ray.remote(num_cpus=1, max_retries=_NODE_LOSSES)(attempt)

    def work(tasks: Sequence[Task]) -> Iterator[Row]:
        waiting = [remote.remote(task) for task in tasks]
        try:
            while waiting:
                done, waiting = ray.wait(waiting)
                yield from ray.get(done)
        finally:
            for each in waiting:
                ray.cancel(each, force=True)
            ray.shutdown()

    return work
