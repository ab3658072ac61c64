"""Launches with CUDA that cost the host little: contexts that are kept, and graphs.

Taichi starts each loop of a kernel by itself, which takes the host 5 us, and has arrays looked up in every launch. A
graph of CUDA starts all loops at once, and the device waits less between them
(docs/decisions/0054-threads-that-stay.md). Its functions are of the PTX that Taichi gives to the driver. Of that it
writes a file where it is asked to, into the working folder; so kernels are launched for the first time by a thread that
has a folder of its own. Where the system lets threads have none, as in some containers, Taichi launches every kernel.

This relies on Taichi's internals, as `sim.core.launch` does.
"""

import contextlib
import ctypes
import functools
import os
import re
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from taichi._lib import core as _ti_core
from taichi.lang import impl

from sim.core.cuda_driver import ask, check, driver

FOLDER_OF_ITS_OWN = 0x200  # CLONE_FS of unshare(2)

LOG_LEVELS = ("trace", "debug", "info", "warn", "error", "critical")

ENTRY = re.compile(r"\.visible \.entry (\w+_kernel_(\d+)_(\w+))\([^)]*\)\s*\.maxntid (\d+), 1, 1\s")
"""Of a kernel's task in PTX: its name, with its number among the kernel's tasks and its kind; threads of a block."""

ONE_THREAD, LOOP = "serial", "range_for"
"""Kinds of tasks that a graph can have."""

SEEN_BY_DEVICE = ctypes.c_uint(2)  # CU_MEMHOSTALLOC_DEVICEMAP

MULTIPROCESSORS, THREADS_OF_MULTIPROCESSOR = 16, 39  # numbers of a device's attributes


class Task(NamedTuple):
    """A loop of a kernel, or what one thread does before it."""

    function: int  # of the driver
    blocks: int
    threads: int  # of a block


class Tasks(NamedTuple):
    """All tasks of a kernel, in order, in a context of the driver."""

    context: int
    tasks: list[Task]


class HostBuffers:
    """Where a launch context has its arguments and its result in the host's memory.

    A launch by Taichi writes into the context where the device's copies of both are, which are gone after it.

    Attributes:
        read: address of what kernels get of the context.
        arguments, result: address and size [bytes] of both.

    Raises:
        RuntimeError: a context looks otherwise in memory than that of Taichi 1.7.4.
    """

    def __init__(self, context: Any) -> None:
        # pybind11 has the address of an object behind the head of its Python object. A context begins with those of
        # its kernel, of what kernels read (owned, and again), of its two buffers, and of a type; then come a size, a
        # type and a size.
        words = [_word(_word(id(context) + 16).value + 8 * place).value for place in range(9)]
        _, owned, self.read, arguments, result, _, arguments_size, _, result_size = words
        if owned != self.read:
            raise RuntimeError(OTHER_LAYOUT)
        self.arguments, self.result = (arguments, arguments_size), (result, result_size)
        self._arguments, self._result = _word(self.read), _word(self.read + 24)
        if (self._arguments.value, self._result.value) != (arguments, result):
            raise RuntimeError(OTHER_LAYOUT)

    def restore(self) -> None:
        """Have the context know them again."""
        self._arguments.value, self._result.value = self.arguments[0], self.result[0]


OTHER_LAYOUT = "a launch context of Taichi has another layout than that of release 1.7.4"


def _word(address: int) -> ctypes.c_uint64:
    """Eight bytes of the memory of this process."""
    return ctypes.c_uint64.from_address(address)


class Graph:
    """All tasks of a kernel, one after the other, with the arrays of a context.

    Args:
        tasks: of the kernel.
        buffers: of a context that Taichi has launched before.
    """

    def __init__(self, tasks: Tasks, buffers: HostBuffers) -> None:
        self._context = ctypes.c_void_p(tasks.context)
        _make_current(self._context)
        (arguments, size), (result, result_size) = buffers.arguments, buffers.result
        self._memory, self._answer = ctypes.c_void_p(), ctypes.c_void_p()
        ask("cuMemAlloc_v2", ctypes.byref(self._memory), ctypes.c_size_t(max(size, 1)))
        if result_size:
            ask("cuMemHostAlloc", ctypes.byref(self._answer), ctypes.c_size_t(result_size), SEEN_BY_DEVICE)
        read = (ctypes.c_uint64 * 4).from_buffer_copy(ctypes.string_at(buffers.read, 32))
        read[0], read[3] = self._memory.value or 0, self._answer.value or 0
        self._graph = _instance_of(tasks.tasks, ctypes.addressof(read))
        self._put = self._memory, ctypes.c_void_p(arguments), ctypes.c_size_t(size), None
        self._taken = result, self._answer, result_size
        self._is_new = True

    def __del__(self) -> None:
        if hasattr(self, "_graph") and not sys.is_finalizing():  # with the process all is gone
            _make_current(self._context)
            ask("cuGraphExecDestroy", self._graph)
            ask("cuMemFree_v2", self._memory)
            if self._answer:
                ask("cuMemFreeHost", self._answer)

    def launch(self, *, is_changed: bool) -> None:
        """Launch behind all that was asked for.

        Args:
            is_changed: whether arguments differ from those of the launch before.
        """
        _make_current(self._context)
        library = driver()
        if is_changed or self._is_new:
            # Memory that can be swapped out is read before the call returns.
            check(library.cuMemcpyHtoDAsync_v2(*self._put), "cuMemcpyHtoDAsync")
            self._is_new = False
        check(library.cuGraphLaunch(self._graph, None), "cuGraphLaunch")

    def take_result(self) -> None:
        """Let the context have the result, which the device has written into memory of the host, after a wait."""
        ctypes.memmove(*self._taken)


class _Node(ctypes.Structure):
    """CUDA_KERNEL_NODE_PARAMS of the driver."""

    _fields_ = (
        ("function", ctypes.c_void_p),
        *((name, ctypes.c_uint) for name in ("blocks", "blocks_y", "blocks_z", "threads", "threads_y", "threads_z")),
        ("shared_bytes", ctypes.c_uint),
        *((name, ctypes.c_void_p) for name in ("arguments", "extra", "kernel", "context")),
    )


def _instance_of(tasks: Sequence[Task], argument: int) -> ctypes.c_void_p:
    """A graph that can be launched, of tasks that all have the same argument, at an address."""
    graph, instance = ctypes.c_void_p(), ctypes.c_void_p()
    ask("cuGraphCreate", ctypes.byref(graph), ctypes.c_uint(0))
    arguments = (ctypes.c_void_p * 1)(argument)
    node = ctypes.c_void_p()
    for place, task in enumerate(tasks):
        parameters = _Node(task.function, task.blocks, 1, 1, task.threads, 1, 1, 0, ctypes.addressof(arguments))
        before, node = (ctypes.c_void_p * 1)(node.value), ctypes.c_void_p()
        count = ctypes.c_size_t(place > 0)  # of tasks that it waits for
        ask("cuGraphAddKernelNode_v2", ctypes.byref(node), graph, before, count, ctypes.byref(parameters))
    ask("cuGraphInstantiateWithFlags", ctypes.byref(instance), graph, ctypes.c_ulonglong(0))
    ask("cuGraphDestroy", graph)
    return instance


_threads = threading.local()


def _make_current(context: ctypes.c_void_p) -> None:
    """Have the driver compute in a context in this thread."""
    if getattr(_threads, "context", None) != context.value:
        ask("cuCtxSetCurrent", context)
        _threads.context = context.value


def tasks_of(kernel: str, first_launch: Callable[[], Any]) -> tuple[Any, Tasks | None]:
    """What the first launch of a kernel of this name returns, and its tasks; None where they are not to be had."""
    result, texts = watched(first_launch)
    own = [text for text in texts if f".visible .entry {kernel}_c".encode() in text]
    entries = entries_of(own[0].decode()) if len(own) == 1 else None
    compiling = _compiling_thread()
    if entries is None or compiling is None:
        return result, None
    # There, Taichi's context is the current one since the launch.
    return result, compiling.pool.submit(_loaded, own[0], entries).result()


def entries_of(ptx: str) -> list[tuple[str, str, int]] | None:
    """Name, kind and threads of a block of each task of a kernel, in order; None where a graph cannot have them."""
    entries = sorted((int(number), name, kind, int(threads)) for name, number, kind, threads in ENTRY.findall(ptx))
    if len(entries) != ptx.count(".visible .entry ") or any(kind not in (ONE_THREAD, LOOP) for *_, kind, _ in entries):
        return None
    return [entry[1:] for entry in entries]


def _loaded(ptx: bytes, entries: Sequence[tuple[str, str, int]]) -> Tasks:
    """Tasks in the driver, which has compiled them before and remembers it; loops of them fill the device once."""
    context, module, device, tasks = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_int(), []
    ask("cuCtxGetCurrent", ctypes.byref(context))
    ask("cuModuleLoadData", ctypes.byref(module), ctypes.c_char_p(ptx))
    ask("cuCtxGetDevice", ctypes.byref(device))
    held = 1
    for attribute in (MULTIPROCESSORS, THREADS_OF_MULTIPROCESSOR):
        number = ctypes.c_int()
        ask("cuDeviceGetAttribute", ctypes.byref(number), attribute, device)
        held *= number.value
    for name, kind, threads in entries:
        function = ctypes.c_void_p()
        ask("cuModuleGetFunction", ctypes.byref(function), module, name.encode())
        assert function.value is not None
        tasks.append(Task(function.value, *((1, 1) if kind == ONE_THREAD else (held // threads, threads))))
    assert context.value is not None
    return Tasks(context.value, tasks)


def makes_graphs() -> bool:
    """Whether this system lets kernels be graphs; where not, Taichi launches each, as `pipeline doctor` says."""
    return _compiling_thread() is not None


def watched(first_launch: Callable[[], Any]) -> tuple[Any, list[bytes]]:
    """What a call returns, and the PTX that Taichi wrote in it, if any."""
    compiling = _compiling_thread()
    if compiling is None:
        return first_launch(), []
    with _writes_ptx():
        result = compiling.pool.submit(first_launch).result()
    files = sorted(compiling.folder.glob("*.ptx"))
    texts = [file.read_bytes() for file in files]
    for file in files:
        file.unlink()
    return result, texts


class _CompilingThread(NamedTuple):
    """A thread with a working folder of its own, that is gone with the process."""

    pool: ThreadPoolExecutor
    folder: Path
    until_then: Any


@functools.cache
def _compiling_thread() -> _CompilingThread | None:
    """The one of this process; None where the system lets threads have no folder of their own."""
    if not hasattr(os, "sched_getaffinity"):  # Linux alone knows unshare
        return None
    folder = tempfile.TemporaryDirectory(prefix="ptx-")
    pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="compiling")

    def enter() -> bool:
        if ctypes.CDLL(None).unshare(FOLDER_OF_ITS_OWN) != 0:
            return False
        os.chdir(folder.name)
        return True

    if not pool.submit(enter).result():
        pool.shutdown()
        folder.cleanup()
        return None
    return _CompilingThread(pool, Path(folder.name), folder)


@contextlib.contextmanager
def _writes_ptx() -> Iterator[None]:
    """Taichi writes the PTX of kernels to files meanwhile, and does not tell of it."""
    level = next(level for level in LOG_LEVELS if _ti_core.logging_effective(level))
    config = impl.current_cfg()
    config.print_kernel_asm = True
    _ti_core.set_logging_level("warn" if LOG_LEVELS.index(level) < LOG_LEVELS.index("warn") else level)
    try:
        yield
    finally:
        config.print_kernel_asm = False
        _ti_core.set_logging_level(level)
