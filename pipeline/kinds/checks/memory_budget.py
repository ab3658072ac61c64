"""Memory budget of a simulation: the GPU's where that computes, else the machine's."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass

import psutil

from pipeline.model.job import Job

SHARE = 0.9
"""Share of what is free now that a simulation may claim; the rest is the driver's, the runner's and other stages'."""


@dataclass(frozen=True, slots=True)
class MemoryBudget:
    """Memory that a simulation may take.

    Attributes:
        bytes: how much.
        owner: whose it is, in words.
        on_gpu: it is a GPU's own: what is on the way to the disk does not count.
    """

    bytes: int
    owner: str
    on_gpu: bool = False


def memory_budget(job: Job) -> MemoryBudget:
    """Free memory for the job's simulation, where it would run.

    Of GPUs only Nvidia's tell. For others, and for a device that does not work here, which is refused elsewhere, the
    machine's memory counts: it is the bound that is left.
    """
    from sim.core.runtime import DeviceUnavailableError, resolve_device

    try:
        device = resolve_device(job.device)
    except DeviceUnavailableError:
        device = "cpu"
    free = free_gpu_bytes() if device == "cuda" else None
    if free is not None:
        return MemoryBudget(int(SHARE * free), "the GPU", on_gpu=True)
    return MemoryBudget(int(SHARE * psutil.virtual_memory().available), "this machine")


class _NvmlMemory(ctypes.Structure):
    _fields_ = (("total", ctypes.c_ulonglong), ("free", ctypes.c_ulonglong), ("used", ctypes.c_ulonglong))


def free_gpu_bytes() -> int | None:
    """Free memory of the first Nvidia GPU that this process may use [bytes]; None where no driver tells.

    Asks the management library that comes with the driver (NVML); unlike CUDA itself it takes no memory of the GPU. It
    counts GPUs by their slots, CUDA the fastest first: where they differ, name one by its UUID in CUDA_VISIBLE_DEVICES.
    Of a GPU in slices (MIG), too, only a UUID tells which; by number it is the whole.
    """
    try:
        library = ctypes.CDLL("libnvidia-ml.so.1")
    except OSError:
        return None
    if library.nvmlInit_v2() != 0:
        return None
    try:
        handle, memory = ctypes.c_void_p(), _NvmlMemory()
        first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0].strip()
        if first.isdigit():
            found = library.nvmlDeviceGetHandleByIndex_v2(ctypes.c_uint(int(first)), ctypes.byref(handle))
        else:
            found = library.nvmlDeviceGetHandleByUUID(first.encode(), ctypes.byref(handle))
        if found != 0 or library.nvmlDeviceGetMemoryInfo(handle, ctypes.byref(memory)) != 0:
            return None
        return int(memory.free)
    finally:
        library.nvmlShutdown()
