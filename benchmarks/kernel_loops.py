"""Kernels that do next to nothing, whose loops are parallel or serial: what is timed is all the rest."""

import taichi as ti

Numbers = ti.types.ndarray(ti.f32, 1)


@ti.kernel
def one_parallel_loop(numbers: Numbers):
    for i in range(numbers.shape[0]):
        numbers[i] = 1.0


@ti.kernel
def four_parallel_loops(numbers: Numbers):
    for i in range(numbers.shape[0]):
        numbers[i] = 1.0
    for i in range(numbers.shape[0]):
        numbers[i] = 2.0
    for i in range(numbers.shape[0]):
        numbers[i] = 3.0
    for i in range(numbers.shape[0]):
        numbers[i] = 4.0


@ti.kernel
def one_serial_loop(numbers: Numbers):
    ti.loop_config(serialize=True)
    for i in range(numbers.shape[0]):
        numbers[i] = 1.0


@ti.kernel
def four_serial_loops(numbers: Numbers):
    ti.loop_config(serialize=True)
    for i in range(numbers.shape[0]):
        numbers[i] = 1.0
    ti.loop_config(serialize=True)
    for i in range(numbers.shape[0]):
        numbers[i] = 2.0
    ti.loop_config(serialize=True)
    for i in range(numbers.shape[0]):
        numbers[i] = 3.0
    ti.loop_config(serialize=True)
    for i in range(numbers.shape[0]):
        numbers[i] = 4.0
