import numpy as np
import pytest
import taichi as ti
from scipy.integrate import trapezoid

from sim.fluid.kernels import (
    SUPPORT_IN_SPACINGS,
    distance,
    evaluate,
    inverse_distance,
    lattice_offsets,
    particle_volume,
    spline,
    spline_slope,
    wall_calibration,
    wall_layers,
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


def layer_field(coordinates, height: float, support: float) -> float:
    """Sum of W over a square layer of points at a height [spacings]."""
    in_plane = np.hypot(coordinates[:, None], coordinates[None, :])
    return float(evaluate(np.hypot(in_plane, height), support).sum())


@pytest.mark.parametrize("support", [2.0, 2.5, 3.0, 4.0])
def test_particle_volume_fills_the_lattice_at_every_support(support):
    distances = np.linalg.norm(lattice_offsets(support), axis=1)
    volume = particle_volume(1.0, support)
    assert volume * evaluate(distances, support).sum() == pytest.approx(1.0, abs=1e-12)  # float64 rounding
    assert volume == pytest.approx(1.0, abs=1e-3 if support == SUPPORT_IN_SPACINGS else 2e-3)


@pytest.mark.parametrize("support", [2.0, 2.5, 3.0, 4.0])
def test_wall_calibration_completes_the_density_and_the_push_of_a_half_space(support):
    calibration = wall_calibration(support)
    axis, fine_axis = np.arange(-6.0, 6.0), np.arange(-6.0, 6.0, 0.0625)

    def field(coordinates, height):
        return layer_field(coordinates, height, support)

    def slope(coordinates, height):
        return (field(coordinates, height + 1e-4) - field(coordinates, height - 1e-4)) / 2e-4

    # Samples at every sixteenth of a spacing are the average over all sideways shifts of the wall.
    sample_volume = calibration.volume_factor / field(axis, 0.0) * 0.0625**2
    volume, standoff = particle_volume(1.0, support), calibration.standoff_in_spacings
    missing = np.arange(1.0, support)
    # The calibration averages over eighths instead: both are the integral over the layer to about 1e-4.
    assert sample_volume * field(fine_axis, standoff) == pytest.approx(
        volume * sum(field(axis, distance) for distance in missing), rel=1e-3
    )
    assert sample_volume * slope(fine_axis, standoff) == pytest.approx(
        2.0 * volume * sum(slope(axis, distance) for distance in missing), rel=1e-3
    )
    # What the docstring says of the second layer of a wider support: at most 7 % of the density is left out.
    left_out = volume * sum(field(axis, 1.0 + distance) for distance in missing) - sample_volume * field(
        fine_axis, standoff + 1.0
    )
    assert left_out < 0.07
    assert (left_out > 0.0) == (support > SUPPORT_IN_SPACINGS)


def test_a_wall_has_one_layer_at_the_usual_support():
    assert wall_layers() == (wall_calibration(),)


@pytest.mark.parametrize("support", [2.05, 2.25, 2.5, 2.75, 3.0, 3.25, 3.5, 3.75, 4.0])
def test_two_layers_complete_both_layers_of_particles_and_push_the_first(support):
    axis, fine_axis = np.arange(-6.0, 6.0), np.arange(-6.0, 6.0, 0.0625)
    volume, step = particle_volume(1.0, support), 1e-4

    def missing(height):
        return volume * sum(layer_field(axis, distance + height, support) for distance in np.arange(1.0, support + 1.0))

    def given(height):
        return sum(
            layer.volume_in_particles
            * volume
            * 0.0625**2
            * layer_field(fine_axis, layer.standoff_in_spacings + height, support)
            for layer in wall_layers(support)
        )

    assert all(layer.volume_in_particles > 0.0 for layer in wall_layers(support))
    # Averages over eighths and sixteenths of a spacing, as for the usual support.
    assert given(0.0) == pytest.approx(missing(0.0), rel=1e-3)
    assert given(1.0) == pytest.approx(missing(1.0), abs=3e-4)
    slope = (given(step) - given(-step)) / (2.0 * step)
    missing_slope = (missing(step) - missing(-step)) / (2.0 * step)
    assert slope == pytest.approx(2.0 * missing_slope, rel=2e-3)


@ti.kernel
def tabulate_distances(
    r_squared: ti.types.ndarray(dtype=ti.f32, ndim=1),
    root: ti.types.ndarray(dtype=ti.f32, ndim=1),
    inverse: ti.types.ndarray(dtype=ti.f32, ndim=1),
):
    for i in range(r_squared.shape[0]):
        root[i] = distance(r_squared[i])
        inverse[i] = inverse_distance(r_squared[i])


def test_distances_from_their_squares_are_right_and_finite_at_zero(taichi_cpu):
    exact = np.concatenate([[0.0], np.logspace(-6, 3, 100)])
    squares = (exact**2).astype(np.float32)
    root, inverse = np.zeros_like(squares), np.zeros_like(squares)
    tabulate_distances(squares, root, inverse)
    # A few float32 roundings of 6e-8 each; the approximate reciprocal root of a GPU errs by 2e-7.
    np.testing.assert_allclose(root, exact, rtol=5e-7)
    np.testing.assert_allclose(inverse[1:] * exact[1:], 1.0, rtol=5e-7)
    assert np.isfinite(inverse[0])
    assert squares[0] * inverse[0] == 0.0
