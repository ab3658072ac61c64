import numpy as np
import pytest
import taichi as ti
from taichi.lang import impl

from sim.core import cuda_launch
from sim.core.launch import LAUNCHES_BEFORE_GRAPH, MOST_LAUNCHES, FastKernel, kernel, large_kernel, on_compiled

Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
AnyNumbers = ti.types.ndarray(ndim=1)
Cells = ti.types.vector(3, ti.i32)
Pair = ti.types.vector(2, ti.f32)


@kernel
def fill(
    numbers: Floats, count: ti.i32, factor: ti.f32, power: ti.template(), shift: ti.math.vec3, cell: Cells
) -> ti.i32:
    """Uses every kind of argument."""
    for i in range(count):
        value = factor * i
        for _ in ti.static(range(power)):
            value *= factor
        numbers[i] = value + shift[0] + 10.0 * shift[1] + 100.0 * shift[2] + cell[0] + 10 * cell[1] + 100 * cell[2]
    return count + cell[2]


@kernel
def place(numbers: Floats, value: ti.f32):
    numbers[0] = value


@kernel
def ends(numbers: Floats, count: ti.i32) -> Pair:
    return Pair(numbers[0], numbers[count - 1])


@kernel
def halve(numbers: AnyNumbers):
    for i in range(numbers.shape[0]):
        numbers[i] = numbers[i] / 2


optimized: list[bool] = []


def note_optimization() -> float:
    optimized.append(impl.current_cfg().advanced_optimization)
    return 0.0


@large_kernel
def quarter(numbers: Floats):
    for i in range(numbers.shape[0]):
        numbers[i] = 0.25 * numbers[i] + ti.static(note_optimization())


@kernel
def double(numbers: Floats):
    for i in range(numbers.shape[0]):
        numbers[i] = 2.0 * numbers[i]


@kernel
def refuse_doubles(numbers: Floats):
    for i in range(numbers.shape[0]):
        numbers[i] = 0.0


def test_results_can_be_asked_for_later(taichi_cpu):
    numbers = ti.ndarray(ti.f32, 3)
    numbers.from_numpy(np.array([1.0, 2.0, 5.0], dtype=np.float32))
    for _ in range(2):  # as it is compiled, and from then on
        asked, counted = ends.later(numbers, 3), fill.later(numbers, 2, 0.0, 0, (0.0, 0.0, 0.0), (0, 0, 0))
        assert (counted(), list(asked())) == (2, [1.0, 5.0])
        numbers.from_numpy(np.array([1.0, 2.0, 5.0], dtype=np.float32))


def test_later_calls_pass_every_argument_as_the_first_one_does(taichi_cpu):
    for count, factor, power, shift, cell in (
        (5, 2.0, 0, (1.0, 2.0, 3.0), (4, 5, 6)),
        (3, 3.0, 0, (0.5, 0.25, 0.125), (-1, -2, -3)),
        (4, 2.0, 2, ti.math.vec3(7.0, 8.0, 9.0), Cells(1, 2, 3)),
        (5, 1.5, 2, (7.0, 8.0, 9.0), (3, 2, 1)),
    ):
        numbers = ti.ndarray(ti.f32, 5)
        numbers.fill(-1.0)
        returned = fill(numbers, count, factor, power, shift, cell)
        offset = np.array(shift) @ (1, 10, 100) + np.array(cell) @ (1, 10, 100)
        expected = np.full(5, -1.0)
        expected[:count] = factor ** (power + 1) * np.arange(count) + offset
        # Multiples of 1/8 below 2^14: exact in float32.
        np.testing.assert_array_equal(numbers.to_numpy(), expected)
        assert returned == count + cell[2]
        assert list(ends(numbers, 5)) == [expected[0], expected[4]]


def test_calls_that_come_again_write_to_the_arrays_of_the_call(taichi_cpu):
    """Also where arrays take turns, and where a new one has the place in memory of one that is gone."""
    first, second = ti.ndarray(ti.f32, 4), ti.ndarray(ti.f32, 4)
    for k in range(4):
        for numbers, scale in ((first, 1.0), (second, -1.0)):
            fill(numbers, 4, scale * k, 0, (0.0, 0.0, 0.0), (0, 0, 0))
            np.testing.assert_array_equal(numbers.to_numpy(), scale * k * np.arange(4))
    for length in (4, 1000, 4, 7):
        halved = ti.ndarray(ti.f32, length)
        halved.fill(length)
        for power in (1, 2):
            halve(halved)
            np.testing.assert_array_equal(halved.to_numpy(), length / 2**power)
        del halved


def test_numbers_that_are_equal_but_not_the_same_are_passed(taichi_cpu):
    numbers = ti.ndarray(ti.f32, 2)
    for value in (0.0, -0.0, 0.0, 2.5, float("2.5"), float("nan"), float("nan"), -0.0):
        numbers.fill(1.0)
        place(numbers, value)
        assert repr(float(numbers.to_numpy()[0])) == repr(value)


def test_with_cuda_calls_that_come_again_are_graphs(taichi_cpu):
    @kernel
    def count_up(numbers: Floats, by: ti.f32) -> ti.f32:
        for i in range(numbers.shape[0]):
            numbers[i] += by
        for i in range(numbers.shape[0]):
            numbers[i] *= 2.0
        return numbers[1]

    numbers, expected = ti.ndarray(ti.f32, 3), 0.0
    numbers.fill(0.0)
    for call in range(LAUNCHES_BEFORE_GRAPH + 4):
        by = 0.5 * (call // 2)
        expected = 2.0 * (expected + by)
        assert count_up(numbers, by) == expected
    np.testing.assert_array_equal(numbers.to_numpy(), expected)
    (launch,) = count_up._launches.values()
    has_graphs = impl.current_cfg().arch == ti.cuda and cuda_launch._compiling_thread() is not None
    assert (launch.graph is not None) == has_graphs


def test_a_kernel_forgets_calls_rather_than_remember_ever_more(taichi_cpu):
    kept = [ti.ndarray(ti.f32, 2) for _ in range(MOST_LAUNCHES + 10)]
    for _ in range(2):
        for number, array in enumerate(kept):
            fill(array, 2, 1.0, 0, (number, 0.0, 0.0), (0, 0, 0))
    assert len(fill._launches) <= MOST_LAUNCHES
    np.testing.assert_array_equal([array.to_numpy()[0] for array in kept], np.arange(len(kept)))


def test_each_element_type_has_its_own_compiled_kernel(taichi_cpu):
    for dtype, expected in ((ti.f32, 1.5), (ti.i32, 1), (ti.f32, 1.5), (ti.i32, 1)):
        numbers = ti.ndarray(dtype, 4)
        numbers.fill(3)
        halve(numbers)
        np.testing.assert_array_equal(numbers.to_numpy(), expected)


def test_an_array_of_the_wrong_type_is_refused_after_a_right_one_too(taichi_cpu):
    refuse_doubles(ti.ndarray(ti.f32, 4))
    with pytest.raises(TypeError, match="f64"):
        refuse_doubles(ti.ndarray(ti.f64, 4))


def test_the_first_call_returns_what_later_ones_do(taichi_cpu):
    @kernel
    def both(numbers: Floats) -> Pair:
        return Pair(numbers[0], numbers[1])

    numbers = ti.ndarray(ti.f32, 2)
    numbers.fill(0.1)
    for _ in range(2):
        returned = both(numbers)
        assert returned == [float(np.float32(0.1))] * 2
        assert {type(number) for number in returned} == {float}  # an artifact has 4 or 8 bytes of it


def test_a_number_of_the_wrong_type_is_refused(taichi_cpu):
    numbers = ti.ndarray(ti.f32, 4)
    assert list(ends(numbers, 4)) == [0.0, 0.0]
    with pytest.raises(TypeError):
        ends(numbers, "4")


def test_a_kernel_with_arguments_that_cannot_be_passed_is_refused(taichi_cpu):
    @ti.kernel
    def of_matrix(matrix: ti.math.mat3) -> ti.f32:
        return matrix[0, 0]

    with pytest.raises(TypeError, match="cannot pass"):
        FastKernel(of_matrix)


def test_a_kernel_that_is_compiled_is_told_once(taichi_cpu, monkeypatch):
    monkeypatch.setattr("sim.core.launch.SLOW_S", 0.0)  # this small one may come out of Taichi's cache
    told = []
    on_compiled(lambda name, seconds: told.append((name, seconds > 0.0)))
    try:
        for _ in range(3):
            double(ti.ndarray(ti.f32, 4))
    finally:
        on_compiled(None)
    double(ti.ndarray(ti.f32, 4))
    assert told == [("double", True)]


def test_a_large_kernel_is_compiled_without_taichis_optimizations_on_a_cpu(taichi_cpu):
    numbers = ti.ndarray(ti.f32, 3)
    numbers.from_numpy(np.array([4.0, 8.0, 12.0], dtype=np.float32))
    for _ in range(2):
        quarter(numbers)
    assert numbers.to_numpy().tolist() == [0.25, 0.5, 0.75]
    assert optimized == [taichi_cpu != "cpu"]
    assert impl.current_cfg().advanced_optimization  # of all others
