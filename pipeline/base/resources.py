"""Resources of this machine, and what of them a task claims."""

import os
from dataclasses import replace

from pipeline.base.memory import machine_memory_bytes
from pipeline.base.task import Resources

MEMORY_SHARE = 0.9  # share of the physical memory that tasks may claim; the rest is the system's and the runner's own


def machine_capacity(*, gpus: int = 0) -> Resources:
    """Cores this process may use, memory of the machine [bytes], and as many GPUs as the caller has found."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Resources(cores=cores, memory_bytes=int(machine_memory_bytes() * MEMORY_SHARE), gpus=gpus)


def claim(request: Resources, capacity: Resources) -> Resources:
    """Resources of a request on a machine of this capacity.

    `cores = 0` stands for all cores. Who asks for more cores or memory than there is gets all of it, and so runs alone.

    Raises ValueError: it needs more GPUs than there are.
    """
    if request.gpus > capacity.gpus:
        raise ValueError(f"needs {request.gpus} GPUs, but this machine offers {capacity.gpus}")
    return Resources(
        cores=min(request.cores or capacity.cores, capacity.cores),
        memory_bytes=min(request.memory_bytes, capacity.memory_bytes),
        gpus=request.gpus,
    )


def whole_machine(request: Resources, capacity: Resources) -> Resources:
    """All cores and memory: what a task gets that ran out of memory beside others."""
    return replace(capacity, gpus=request.gpus)
