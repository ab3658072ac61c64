"""What launches with CUDA need that can be had without."""

import ctypes
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import taichi as ti
from taichi.lang import impl

from sim.core import cuda_driver, cuda_launch
from sim.core.cuda_launch import Graph, HostBuffers, entries_of, tasks_of, watched
from sim.core.launch import ADDRESS_OF_ARRAY, kernel

Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)

PTX = """
.visible .entry halve_c80_0_kernel_1_range_for(
	.param .align 8 .b8 halve_c80_0_kernel_1_range_for_param_0[32]
)
.maxntid 128, 1, 1
{
}
	// .globl	halve_c80_0_kernel_10_range_for
.visible .entry halve_c80_0_kernel_10_range_for(
	.param .align 8 .b8 halve_c80_0_kernel_10_range_for_param_0[32]
)
.maxntid 1024, 1, 1
{
}
.visible .entry halve_c80_0_kernel_0_serial(
	.param .align 8 .b8 halve_c80_0_kernel_0_serial_param_0[32]
)
.maxntid 1, 1, 1
{
}
"""


@kernel
def double(numbers: Floats):
    for i in range(numbers.shape[0]):
        numbers[i] = 2.0 * numbers[i]


def skip_without_folders():
    if cuda_launch._compiling_thread() is None:
        pytest.skip("threads have no folders of their own here")


def context_of_a_launch():
    double(ti.ndarray(ti.f32, 2))
    return next(iter(double._primal.compiled_kernels.values())).make_launch_context()


def test_a_context_gets_back_what_a_launch_replaces(taichi_cpu):
    context = context_of_a_launch()
    buffers = HostBuffers(context)
    (arguments, size), (result, result_size) = buffers.arguments, buffers.result
    assert (size, result_size) == (16, 0)  # a length, which is padded, and an address
    words = buffers._arguments, buffers._result
    for word in words:
        word.value = 16
    buffers.restore()
    assert [word.value for word in words] == [arguments, result]
    context.set_struct_arg_uint((0, ADDRESS_OF_ARRAY), 0x1234)
    assert ctypes.c_uint64.from_address(arguments + 8).value == 0x1234


def test_memory_that_looks_otherwise_than_a_context_is_refused(taichi_cpu):
    context = context_of_a_launch()
    buffers = HostBuffers(context)
    buffers._result.value += 8
    try:
        with pytest.raises(RuntimeError, match=r"1\.7\.4"):
            HostBuffers(context)
    finally:
        buffers.restore()


def test_tasks_are_in_the_order_of_their_numbers():
    assert entries_of(PTX) == [
        ("halve_c80_0_kernel_0_serial", "serial", 1),
        ("halve_c80_0_kernel_1_range_for", "range_for", 128),
        ("halve_c80_0_kernel_10_range_for", "range_for", 1024),
    ]


@pytest.mark.parametrize("change", [("serial", "struct_for"), (".maxntid 1, 1, 1", "")])
def test_a_kernel_with_another_kind_of_task_gets_no_graph(change):
    assert entries_of(PTX.replace(*change)) is None


def test_what_is_written_meanwhile_is_read_from_a_folder_that_no_other_thread_has(taichi_cpu):
    here = Path.cwd()
    folders = []

    def launch() -> int:
        assert impl.current_cfg().print_kernel_asm
        folders.append(Path.cwd())
        Path("taichi_kernel_nvptx_0003.ptx").write_text(PTX)
        return 3

    skip_without_folders()
    for _ in range(2):
        assert watched(launch) == (3, [PTX.encode()])
    assert here == Path.cwd()
    assert here not in folders
    assert not list(folders[0].iterdir())
    assert not impl.current_cfg().print_kernel_asm


class Driver:
    """In place of CUDA's: notes what is asked for, by which thread, and answers with numbers."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, str]] = []

    def __getattr__(self, function: str) -> Callable[..., int]:
        def answer(*arguments: Any) -> int:
            self.asked.append((function, threading.current_thread().name))
            for argument in arguments:
                if hasattr(argument, "_obj"):  # of byref
                    argument._obj.value = 2048 + len(self.asked)
            return 0

        return answer

    def functions(self) -> list[str]:
        """What was asked for since the last time."""
        asked, self.asked = [function for function, _ in self.asked], []
        return asked


def test_a_graph_has_its_tasks_from_the_thread_that_compiled_them_and_gets_new_arguments_alone(taichi_cpu, monkeypatch):
    skip_without_folders()
    driver = Driver()
    for module in (cuda_driver, cuda_launch):
        monkeypatch.setattr(module, "driver", lambda: driver)
    monkeypatch.setattr(cuda_launch, "_threads", threading.local())
    result, tasks = tasks_of("halve", lambda: Path("taichi_kernel_nvptx_0000.ptx").write_text(PTX))
    assert result == len(PTX)
    assert tasks is not None
    assert [(task.blocks == 1, task.threads) for task in tasks.tasks] == [(True, 1), (False, 128), (False, 1024)]
    assert {thread for _, thread in driver.asked} == {"compiling_0"}
    driver.functions()

    graph = Graph(tasks, HostBuffers(context_of_a_launch()))
    assert driver.functions() == [
        "cuCtxSetCurrent",
        "cuMemAlloc_v2",
        "cuGraphCreate",
        *3 * ["cuGraphAddKernelNode_v2"],
        "cuGraphInstantiateWithFlags",
        "cuGraphDestroy",
    ]
    for is_changed, copies in ((False, True), (False, False), (True, True)):
        graph.launch(is_changed=is_changed)
        graph.take_result()
        assert driver.functions() == [*copies * ["cuMemcpyHtoDAsync_v2"], "cuGraphLaunch"]
    in_another = threading.Thread(target=graph.launch, kwargs={"is_changed": False})
    in_another.start()
    in_another.join()
    assert driver.functions() == ["cuCtxSetCurrent", "cuGraphLaunch"]
    del graph
    assert driver.functions() == ["cuGraphExecDestroy", "cuMemFree_v2"]


def test_ptx_of_another_kernel_makes_no_graph(taichi_cpu):
    skip_without_folders()
    assert tasks_of("double", lambda: Path("taichi_kernel_nvptx_0000.ptx").write_text(PTX))[1] is None


def test_where_threads_have_no_folder_of_their_own_nothing_is_watched(taichi_cpu, monkeypatch):
    monkeypatch.setattr(cuda_launch, "_compiling_thread", lambda: None)
    assert watched(lambda: impl.current_cfg().print_kernel_asm) == (False, [])
