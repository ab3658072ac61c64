"""What launches with CUDA need that can be had without."""

import ctypes
from pathlib import Path

import pytest
import taichi as ti
from taichi.lang import impl

from sim.core import cuda_launch
from sim.core.cuda_launch import HostBuffers, entries_of, watched
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

    if cuda_launch._compiling_thread() is None:
        pytest.skip("threads have no folders of their own here")
    for _ in range(2):
        assert watched(launch) == (3, [PTX.encode()])
    assert here == Path.cwd()
    assert here not in folders
    assert not list(folders[0].iterdir())
    assert not impl.current_cfg().print_kernel_asm


def test_where_threads_have_no_folder_of_their_own_nothing_is_watched(taichi_cpu, monkeypatch):
    monkeypatch.setattr(cuda_launch, "_compiling_thread", lambda: None)
    assert watched(lambda: impl.current_cfg().print_kernel_asm) == (False, [])
