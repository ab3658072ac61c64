"""What Taichi says of a kernel that it cannot compile, now that it does not wrap it."""

import pytest
import taichi as ti

from sim.core.bundles import _source_of


@ti.kernel
def wrong(numbers: ti.types.ndarray(ti.f32, 1)):
    for i in range(numbers.shape[0]):
        numbers[i] = 2.0 * unheard_of + numbers[i]  # noqa: F821


@ti.kernel
def wrong_over_lines(numbers: ti.types.ndarray(ti.f32, 1)):
    numbers[0] = ti.max(
        1.0,
        unheard_of,  # noqa: F821
    )


def test_an_error_in_a_kernel_shows_where_it_stands(taichi_cpu):
    with pytest.raises(ti.TaichiNameError) as raised:
        wrong(ti.ndarray(ti.f32, 3))
    said = str(raised.value).strip().splitlines()
    line = wrong._primal.func.__code__.co_firstlineno + 3
    assert said[0] == f'File "{__file__}", line {line}, in wrong:'
    code, underlined = said[1:3]
    assert code.lstrip().startswith("numbers[i] = 2.0 * unheard_of")
    assert code[underlined.index("^") : underlined.rindex("^") + 1] == "unheard_of"


def test_an_error_on_a_later_line_shows_that_line(taichi_cpu):
    with pytest.raises(ti.TaichiNameError) as raised:
        wrong_over_lines(ti.ndarray(ti.f32, 3))
    said = str(raised.value).strip().splitlines()
    assert said[0].startswith(f'File "{__file__}", line ')
    assert said[1].strip().startswith("unheard_of")


@ti.func
def times(number: ti.f32, factor: ti.template()) -> ti.f32:
    product = number
    for _ in ti.static(range(factor - 1)):
        product += number
    return product


@ti.kernel
def thirtyfold(numbers: ti.types.ndarray(ti.f32, 1)):
    for i in range(numbers.shape[0]):
        numbers[i] = times(times(times(numbers[i], 2), 3), 5)


def test_the_source_of_a_function_is_read_once_for_all_of_its_uses(taichi_cpu):
    numbers = ti.ndarray(ti.f32, 3)
    numbers.fill(1.5)
    before = _source_of.cache_info()
    thirtyfold(numbers)
    after = _source_of.cache_info()
    assert (after.misses - before.misses, after.hits - before.hits) == (1, 2)
    assert numbers.to_numpy().tolist() == [45.0] * 3


@ti.func
def wrong_function(number: ti.f32) -> ti.f32:
    return number + unheard_of  # noqa: F821


@ti.kernel
def calls_a_wrong_function(numbers: ti.types.ndarray(ti.f32, 1)):
    numbers[0] = wrong_function(numbers[0])


def test_an_error_in_a_function_shows_where_it_stands_each_time(taichi_cpu):
    for _ in range(2):
        with pytest.raises(ti.TaichiNameError, match=r"in wrong_function:\n +return number \+ unheard_of"):
            calls_a_wrong_function(ti.ndarray(ti.f32, 3))


@ti.func
def factorial(number: ti.template()) -> ti.i32:
    product = 1
    if ti.static(number > 1):
        product = number * factorial(number - 1)
    return product


@ti.kernel
def calls_what_calls_itself() -> ti.i32:
    return factorial(4)


def test_a_function_that_calls_itself_is_refused_by_name(taichi_cpu):
    with pytest.raises(ti.TaichiSyntaxError, match="factorial calls itself"):
        calls_what_calls_itself()
    numbers = ti.ndarray(ti.f32, 1)
    numbers.fill(0.5)
    thirtyfold(numbers)  # tracing goes on
    assert numbers.to_numpy()[0] == 15.0
