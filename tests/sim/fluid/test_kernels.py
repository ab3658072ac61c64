import numpy as np
import pytest
import taichi as ti
from scipy.integrate import trapezoid

from sim.fluid.kernels import (
    SUPPORT_IN_SPACINGS,
    evaluate,
    lattice_offsets,
    particle_volume,
    spline,
    spline_slope,
    wall_calibration,
)


def test_kernel_integrates_to_one():
    support = 0.04
    radius = np.linspace(0.0, support, 20001)
    integral = trapezoid(4.0 * np.pi * radius**2 * evaluate(radius, support), radius)
    # The trapezoidal rule errs by about (interval/h)²/12 ~ 1e-9 here.
    assert integral == pytest.approx(1.0, abs=1e-7)


def test_kernel_equals_the_published_piecewise_polynomial():
    q = np.linspace(0.0, 1.5, 301)
    published = np.where(q < 0.5, 1 - 6 * q**2 + 6 * q**3, np.where(q < 1, 2 * (1 - q) ** 3, 0.0))
    np.testing.assert_allclose(evaluate(q, 1.0), 8.0 / np.pi * published, atol=1e-12)  # float64 rounding


@ti.kernel
def tabulate(
    q: ti.types.ndarray(dtype=ti.f32, ndim=1),
    value: ti.types.ndarray(dtype=ti.f32, ndim=1),
    slope: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    for i in range(q.shape[0]):
        value[i] = spline(q[i])
        slope[i] = spline_slope(q[i])


def test_device_kernel_and_its_slope_agree_with_the_host(taichi_cpu):
    q = np.linspace(0.0, 1.2, 121, dtype=np.float32)
    value, slope = np.zeros_like(q), np.zeros_like(q)
    tabulate(q, value, slope)
    # Values are below 2 and slopes below 2, computed with a handful of float32 roundings of 6e-8 each.
    np.testing.assert_allclose(value, evaluate(q, 1.0) * np.pi / 8.0, atol=2e-6)
    step, exact_q = 1e-5, q.astype(np.float64)
    difference = (evaluate(exact_q + step, 1.0) - evaluate(np.abs(exact_q - step), 1.0)) / (2 * step) * np.pi / 8.0
    np.testing.assert_allclose(slope, difference, atol=1e-4)  # |w''| is at most 12, times the step


def test_gradients_of_a_filled_lattice_sum_to_zero():
    offsets = lattice_offsets()
    distance = np.linalg.norm(offsets, axis=1)
    step = 1e-6
    slope = (evaluate(distance + step, 2.0) - evaluate(np.abs(distance - step), 2.0)) / (2 * step)
    directions = offsets / np.maximum(distance, 1e-12)[:, None]
    np.testing.assert_allclose((slope[:, None] * directions).sum(axis=0), 0.0, atol=1e-9)  # cancels by symmetry


def test_particle_volume_is_the_lattice_cell_within_a_tenth_of_a_percent():
    assert particle_volume(0.02) == pytest.approx(0.02**3, rel=1e-3)


def test_wall_calibration_completes_the_density_and_the_push_of_a_half_space():
    calibration = wall_calibration()
    axis = np.arange(-4.0, 4.0)
    fine_axis = np.arange(-4.0, 4.0, 0.0625)

    def field(coordinates, height):
        in_plane = np.hypot(coordinates[:, None], coordinates[None, :])
        return evaluate(np.hypot(in_plane, height), SUPPORT_IN_SPACINGS).sum()

    def slope(coordinates, height):
        return (field(coordinates, height + 1e-4) - field(coordinates, height - 1e-4)) / 2e-4

    # Samples at every sixteenth of a spacing are the average over all sideways shifts of the wall.
    sample_volume = calibration.volume_factor / field(axis, 0.0) * 0.0625**2
    standoff = calibration.standoff_in_spacings
    # The calibration averages over eighths instead: both are the integral over the layer to about 1e-4.
    assert sample_volume * field(fine_axis, standoff) == pytest.approx(
        particle_volume(1.0) * field(axis, 1.0), rel=1e-3
    )
    assert sample_volume * slope(fine_axis, standoff) == pytest.approx(
        2.0 * particle_volume(1.0) * slope(axis, 1.0), rel=1e-3
    )
