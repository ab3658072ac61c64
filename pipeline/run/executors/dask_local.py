"""A Dask cluster of this machine alone, for trying the cluster out and for tests."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count, islice

import dask
from distributed import Nanny, Scheduler
from distributed.deploy.spec import SpecCluster

from pipeline.base.task import Resources
from pipeline.model.gpus import OWN_GPUS, own_gpus
from pipeline.run.executors.dask_slots import CPU_TAG, GPU_TAG, MEMORY_TAG

SCHEDULER_SETTINGS = {
    "distributed.scheduler.allowed-failures": 0,  # further attempts are the runner's business
    "distributed.scheduler.no-workers-timeout": "5 minutes",
    "distributed.scheduler.work-stealing": False,  # tasks are pinned
}
_HOST = "127.0.0.1"
_HTTP = f"{_HOST}:0"  # Dask listens for HTTP even without a dashboard, and on all addresses if none is named


def split(capacity: Resources, workers: int) -> list[Resources]:
    """Cores and memory in shares as equal as whole numbers allow; GPUs one each, from the first on.

    Raises ValueError: more workers than cores.
    """
    if not 1 <= workers <= capacity.cores:
        raise ValueError(f"{workers} workers cannot share {capacity.cores} cores")
    return [
        Resources(
            cores=(capacity.cores + workers - 1 - index) // workers,
            memory_bytes=capacity.memory_bytes // workers,
            gpus=(capacity.gpus + workers - 1 - index) // workers,
        )
        for index in range(workers)
    ]


@contextmanager
def local_cluster(shares: list[Resources]) -> Iterator[str]:
    """Start a scheduler and a worker for each share, on this machine and for this machine only.

    Yields:
        The scheduler's address.
    """
    workers = {
        index: {"cls": Nanny, "options": _worker_options(share, places)}
        for index, (share, places) in enumerate(zip(shares, gpu_places(shares), strict=True))
    }
    scheduler = {"cls": Scheduler, "options": {"host": _HOST, "dashboard": False, "dashboard_address": _HTTP}}
    with (
        dask.config.set(SCHEDULER_SETTINGS),
        SpecCluster(workers=workers, scheduler=scheduler, silence_logs=logging.CRITICAL) as cluster,
    ):
        yield cluster.scheduler_address


def gpu_places(shares: list[Resources]) -> list[list[int]]:
    """Which of the machine's GPUs each share has, so that no two have the same."""
    own = own_gpus()
    left: Iterator[int] = count() if own is None else iter(own)
    return [[*islice(left, share.gpus)] for share in shares]


def _worker_options(share: Resources, places: list[int]) -> dict[str, object]:
    tags = {CPU_TAG: share.cores, MEMORY_TAG: share.memory_bytes, GPU_TAG: share.gpus}
    return {
        "host": _HOST,
        "nthreads": share.cores,
        "memory_limit": 0,  # Dask would count its own process only; the worker processes have limits of their own
        "resources": {tag: amount for tag, amount in tags.items() if amount},
        "env": {OWN_GPUS: ",".join(map(str, places))},
        "dashboard": False,
        "dashboard_address": _HTTP,
        "silence_logs": logging.CRITICAL,
    }
