"""What Taichi says of a kernel that it cannot compile, now that it does not wrap it."""

import pytest
import taichi as ti

from sim.core.bundles import kernel_impl


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
def doubled(number: ti.f32) -> ti.f32:
    return 2.0 * number


@ti.kernel
def eightfold(numbers: ti.types.ndarray(ti.f32, 1)):
    for i in range(numbers.shape[0]):
        numbers[i] = doubled(doubled(doubled(numbers[i])))


def test_the_source_of_a_function_is_read_once_for_all_of_its_uses(taichi_cpu):
    numbers = ti.ndarray(ti.f32, 3)
    numbers.fill(1.5)
    before = kernel_impl.getsourcelines.cache_info()
    eightfold(numbers)
    after = kernel_impl.getsourcelines.cache_info()
    assert (after.misses - before.misses, after.hits - before.hits >= 2) == (2, True)
    assert numbers.to_numpy().tolist() == [12.0] * 3
