"""Memory budget of a simulation: the GPU's where that computes, else the machine's."""

import ctypes
import os
from dataclasses import dataclass

import psutil

from pipeline.model.amounts import count, gigabytes
from pipeline.model.job import Job
from sim.core.runtime import DeviceUnavailableError, resolve_device

SHARE = 0.9
"""Share of what is free now that a simulation may claim."""


@dataclass(frozen=True, slots=True)
class MemoryBudget:
    """Memory that a simulation may take."""

    bytes: int  # how much
    owner: str  # whose it is, in words
    on_gpu: bool = False  # it is a GPU's own: what is on the way to the disk does not count

    def refusal(
        self, elements: float, called: str, bytes_each: float, *, before: float = 0.0, beside: str = ""
    ) -> str | None:
        """Reason why so many elements, of a memory each [bytes], do not fit with those `before` them; None if they do.

        For people, they are `called` "particles", say, and the others are named in `beside`.
        """
        need = (elements + before) * bytes_each
        if need <= self.bytes:
            return None
        possible = max(0.0, self.bytes // bytes_each - before)
        return (
            f"{count(elements)} {called}{beside} need {gigabytes(need)}, {self.owner} has {gigabytes(self.bytes)}; "
            f"at most {count(possible)} fit"
        )


def memory_budget(job: Job) -> MemoryBudget:
    """Free memory for the job's simulation: that of a GPU if it is Nvidia's, else the machine's."""
    try:
        device = resolve_device(job.chosen_device)
    except DeviceUnavailableError:
        device = "cpu"
    free = free_gpu_bytes() if device == "cuda" else None
    if free is not None:
        return MemoryBudget(int(SHARE * free), "the GPU", on_gpu=True)
    return MemoryBudget(free_bytes(), "this machine")


def free_bytes() -> int:
    """Memory of this machine that a process may claim [bytes]."""
    return int(SHARE * psutil.virtual_memory().available)


class _NvmlMemory(ctypes.Structure):
    _fields_ = (("total", ctypes.c_ulonglong), ("free", ctypes.c_ulonglong), ("used", ctypes.c_ulonglong))


def free_gpu_bytes() -> int | None:
    """Free memory of the first Nvidia GPU that this process may use [bytes]; None where no driver tells.

    The driver's management library (NVML), unlike CUDA, takes no memory of the GPU. It counts GPUs by their slots, CUDA
    the fastest first; where they differ, and for slices (MIG), CUDA_VISIBLE_DEVICES must name a UUID.
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
