"""Whose fault a failure is: the task's, the machine's, or a full disk's."""

import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.task import FailureKind

_DISK_FULL_CODES = {errno.ENOSPC, errno.EDQUOT}
_NO_ANSWER_CODES = {errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN}
"""How a network file system says that its server does not answer, or has started anew."""
_DISK_FULL_TEXT = os.strerror(errno.ENOSPC)
_OUT_OF_MEMORY_TEXTS = ("out of memory", "out of gpu")
"""How libraries that raise RuntimeError say it, in small letters: CUDA and Vulkan by Taichi, and Cycles."""
_GPU_ERROR = re.compile(
    r"cuda[_ ]error|optix_error|vk_error_device_lost|device (was )?lost|illegal address|fallen off the bus|\bxid\b"
    r"|in (cuda|hip|oneapi|metal) queue|failed to create \w+ context|no cuda-capable device"
    r"|(?-i:\bin cu[A-Z]\w+\()",
    re.IGNORECASE,
)
"""How Taichi, Cycles and drivers say that a GPU does not go on; their words for its memory are out_of_memory's."""
_TOLD = {"SimulationDivergedError": FailureKind.DIVERGED, "OutgrownError": FailureKind.OUTGROWN}
_NO_DEVICE = "DeviceUnavailableError"
_BLENDER_LOST = ("BlenderDiedError", "BlenderKilledError")
"""By name: asking isinstance would import the simulation and the renderer into every process."""


def classify(error: BaseException) -> FailureKind:
    """The kind of failure of an exception, by it and by the exceptions behind it."""
    for link in _chain(error):
        if isinstance(link, MemoryError) or _means_out_of_memory(link):
            return FailureKind.OUT_OF_MEMORY
        if _means_disk_full(link):
            return FailureKind.DISK_FULL
        for name, kind in _TOLD.items():
            if _is_called(name, link):
                return kind
        lost_device = _is_called(_NO_DEVICE, link) and getattr(link, "device", "cpu") != "cpu"
        if lost_device or (isinstance(link, RuntimeError) and means_gpu_error(str(link))):
            return FailureKind.GPU_ERROR
        if any(_is_called(name, link) for name in _BLENDER_LOST) or _means_no_answer(link):
            return FailureKind.WORKER_LOST
    return FailureKind.FAILED


def describe(error: BaseException) -> str:
    """One line for the user: our own errors are sentences already, others need their type's name; then their notes."""
    if isinstance(error, PipelineError) or any(_is_called(name, error) for name in _TOLD):
        sentence = str(error)
    else:
        sentence = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return "; ".join([sentence, *getattr(error, "__notes__", [])])


def is_disk_full(error: BaseException) -> bool:
    """Whether an exception comes of a full disk or an exhausted quota."""
    return any(map(_means_disk_full, _chain(error)))


def full_place(error: BaseException) -> str:
    """What could not be written as a disk is full, as far as an exception names it; "" if it does not."""
    full = (link for link in _chain(error) if isinstance(link, OSError) and link.errno in _DISK_FULL_CODES)
    return next((os.fsdecode(link.filename) for link in full if isinstance(link.filename, str | bytes | Path)), "")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception comes of too little memory, of the machine or of a GPU."""
    return classify(error) is FailureKind.OUT_OF_MEMORY


def means_gpu_error(text: str) -> bool:
    """Whether a library's words, or the last ones of a log, tell that a GPU failed."""
    return _GPU_ERROR.search(text) is not None


def _chain(error: BaseException) -> Iterator[BaseException]:
    link: BaseException | None = error
    while link is not None:
        yield link
        link = link.__cause__ or (None if link.__suppress_context__ else link.__context__)


def _means_disk_full(error: BaseException) -> bool:
    if isinstance(error, OSError) and error.errno in _DISK_FULL_CODES:
        return True
    # Some libraries, HDF5 among them, pass the text on and lose the code.
    return isinstance(error, OSError | RuntimeError) and _DISK_FULL_TEXT in str(error)


def _means_no_answer(error: BaseException) -> bool:
    return isinstance(error, OSError) and error.errno in _NO_ANSWER_CODES


def _means_out_of_memory(error: BaseException) -> bool:
    return isinstance(error, RuntimeError) and any(text in str(error).lower() for text in _OUT_OF_MEMORY_TEXTS)


def _is_called(name: str, error: BaseException) -> bool:
    return any(base.__name__ == name for base in type(error).__mro__)
