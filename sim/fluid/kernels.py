"""The cubic spline kernel, and what a filled lattice of particles makes of it.

W(x, h) = sigma w(q), q = |x| / h, sigma = 8 / (pi h³), over the support radius h (Monaghan 1992, written for the
support radius). The piecewise polynomial w is evaluated without branches as

    w(q) = 2 (1 - q)₊³ - 8 (1/2 - q)₊³,    w'(q) = -6 (1 - q)₊² + 24 (1/2 - q)₊²,

which equals 1 - 6q² + 6q³ for q < 1/2, 2 (1 - q)³ for q < 1, and 0 beyond.
"""

import math
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.optimize import brentq

from sim.core.bundles import func
from sim.core.reductions import runs_on_gpu

TINY_DISTANCE = 1.0e-12  # keeps x/|x| finite where two particles coincide; their force is then 0 [m]
SUPPORT_IN_SPACINGS = 2.0  # usual support radius over lattice spacing: 4r over 2r
NEAR_LAYER_IN_SPACINGS = 0.3, 1.2  # between them, from the fluid, is the first of two layers, at any support up to 4


@func
def spline(q: ti.f32) -> ti.f32:
    """Shape w(q) of the kernel; W = sigma w."""
    outer = ti.max(1.0 - q, 0.0)
    inner = ti.max(0.5 - q, 0.0)
    return 2.0 * outer * outer * outer - 8.0 * inner * inner * inner


@func
def spline_slope(q: ti.f32) -> ti.f32:
    """Slope w'(q) of the kernel's shape; grad W = (sigma / h) w' x/|x|."""
    outer = ti.max(1.0 - q, 0.0)
    inner = ti.max(0.5 - q, 0.0)
    return 24.0 * inner * inner - 6.0 * outer * outer


@func
def inverse_distance(r_squared: ti.f32) -> ti.f32:
    """1/|x| from |x|², finite at 0, where |x| is `r_squared * inverse_distance(r_squared)`; fast on a GPU."""
    return ti.rsqrt(r_squared + TINY_DISTANCE * TINY_DISTANCE)


@func
def slope_over_distance(r_squared: ti.f32, inverse_support: ti.f32) -> ti.f32:
    """Factor on (sigma/h) x_ij of grad W_ij; times x_ij it is 0 where two particles coincide."""
    inverse = inverse_distance(r_squared)
    return spline_slope(r_squared * inverse * inverse_support) * inverse


@func
def distance(r_squared: ti.f32) -> ti.f32:
    """|x| from |x|², in the way that is fastest on the device: a CPU would divide to invert."""
    r = ti.sqrt(r_squared)
    if ti.static(runs_on_gpu()):
        r = r_squared * inverse_distance(r_squared)
    return r


def normalization(support_radius: float) -> float:
    """sigma = 8 / (pi h³) [1/m³]."""
    return 8.0 / (np.pi * support_radius**3)


def evaluate(distance: NDArray[np.floating] | float, support_radius: float) -> NDArray[np.float64]:
    """W at a distance [m] on the host, in float64 [1/m³]."""
    q = np.asarray(distance, dtype=np.float64) / support_radius
    outer, inner = np.maximum(1.0 - q, 0.0), np.maximum(0.5 - q, 0.0)
    return normalization(support_radius) * (2.0 * outer**3 - 8.0 * inner**3)


def evaluate_slope(distance: NDArray[np.floating] | float, support_radius: float) -> NDArray[np.float64]:
    """dW/dr at a distance [m] on the host, in float64 [1/m⁴]."""
    q = np.asarray(distance, dtype=np.float64) / support_radius
    outer, inner = np.maximum(1.0 - q, 0.0), np.maximum(0.5 - q, 0.0)
    return normalization(support_radius) / support_radius * (24.0 * inner**2 - 6.0 * outer**2)


def lattice_offsets(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> NDArray[np.float64]:
    """Cubic lattice points within the support of the origin, itself included, in spacings, (n, 3)."""
    axis = _lattice_axis(support_in_spacings)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return points[np.linalg.norm(points, axis=1) < support_in_spacings]


def particle_volume(spacing: float, support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Volume V of a particle [m³] with which a filled lattice has exactly rest density: V = 1 / sum_j W_ij.

    It is d³ to 0.2 % (docs/decisions/0010-particle-volume.md).
    """
    distances = np.linalg.norm(lattice_offsets(support_in_spacings), axis=1) * spacing
    return float(1.0 / evaluate(distances, support_in_spacings * spacing).sum())


@dataclass(frozen=True)
class WallCalibration:
    """What makes a layer of boundary samples act like more fluid, alone or with other layers."""

    standoff_in_spacings: float  # distance from the samples at which a lattice of fluid is at rest
    volume_factor: float  # gamma, on the volume 1 / sum_k W_bk of a sample
    volume_in_particles: float  # volume of a sample of a square layer of the lattice's spacing over that of a particle


@cache
def wall_calibration(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> WallCalibration:
    """The distance and the factor with which a half-space of lattice is at rest density and in equilibrium.

    A particle of the first layer misses the density that more layers would give, sum_j V W_ij, and their push,
    sum_j V (p_i/rho_i² + p_j/rho_j²) grad W_ij: with equal pressures twice what a boundary force with p_i/rho_i² alone
    gives. So the samples need gamma V_b sum_b W(D) = V sum_j W and gamma V_b sum_b W'(D) = 2 V sum_j W', the sums over
    the layers that are missing: the logarithmic slope of the samples' field at distance D is twice theirs. Bisection
    finds D, about 1.45 d. A smaller factor with nearer samples (gamma = 0.7 at D = d, Band et al. 2018) has the density
    right and half of the push; fluid then sinks into the wall.

    A support wider than the usual 2 spacings reaches past the first layer of particles, whose density and push stay
    right; of the second's density one layer of samples leaves out up to 7 %. `wall_layers` has those that complete it.
    """
    low, high = 1.0, 1.0 + 0.95 * (support_in_spacings - 1.0)
    fluid_field, fluid_slope = _missing_field(1, support_in_spacings)
    target = 2.0 * fluid_slope / fluid_field
    for _ in range(60):
        middle = 0.5 * (low + high)
        field, slope = layer_field(middle, support_in_spacings)
        low, high = (low, middle) if slope / field < target else (middle, high)
    field, _ = layer_field(low, support_in_spacings)
    return _calibration(low, fluid_field / field, support_in_spacings)


@cache
def wall_layers(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> tuple[WallCalibration, ...]:
    """The layers of samples of a wall, from the fluid inwards: one at the usual support, two at a wider one.

    The second layer lies half a spacing short of the support from the first layer of particles, which it pushes. The
    volumes of both follow from the two conditions of `wall_calibration`. The distance of the first layer, about a
    spacing, where the lattice would go on, is that with which the second layer of particles has its density as well.
    """
    if support_in_spacings == SUPPORT_IN_SPACINGS:
        return (wall_calibration(),)
    far = support_in_spacings - 0.5

    def volumes(near: float) -> NDArray[np.float64]:
        fields = np.array([layer_field(distance, support_in_spacings) for distance in (near, far)])
        field, slope = _missing_field(1, support_in_spacings)
        return np.linalg.solve(fields.T, [field, 2.0 * slope])

    def excess_of_second_layer(near: float) -> float:
        fields = [layer_field(distance + 1.0, support_in_spacings)[0] for distance in (near, far)]
        return float(volumes(near) @ fields) - _missing_field(2, support_in_spacings)[0]

    near = float(brentq(excess_of_second_layer, *NEAR_LAYER_IN_SPACINGS, xtol=1.0e-9))
    return tuple(
        _calibration(distance, volume, support_in_spacings)
        for distance, volume in zip((near, far), volumes(near), strict=True)
    )


def wall_share(support_in_spacings: float = SUPPORT_IN_SPACINGS) -> float:
    """Share of the bond between a sample of a wall and a particle of the first layer that lies in the fluid [-].

    The wall's face is half a spacing from the particle. Of two layers of samples each counts as much as it pushes.
    """
    layers = wall_layers(support_in_spacings)
    distances = np.array([layer.standoff_in_spacings for layer in layers])
    pushes = [
        layer.volume_in_particles * layer_field(layer.standoff_in_spacings, support_in_spacings)[1] for layer in layers
    ]
    return float(0.5 / np.average(distances, weights=pushes))


def _calibration(standoff: float, volume_in_particles: float, support_in_spacings: float) -> WallCalibration:
    samples_sum, _ = layer_field(0.0, support_in_spacings, shifts=1)
    factor = volume_in_particles * samples_sum * particle_volume(1.0, support_in_spacings)
    return WallCalibration(standoff, float(factor), float(volume_in_particles))


def _missing_field(layer: int, support_in_spacings: float) -> tuple[float, float]:
    """Sum of W over the layers that a wall takes from a layer of fluid, 1 for the one next to it, and its slope."""
    missing = [
        layer_field(distance, support_in_spacings, shifts=1)
        for distance in np.arange(float(layer), support_in_spacings)
    ]
    field, slope = np.sum([(0.0, 0.0), *missing], axis=0)
    return float(field), float(slope)


def _lattice_axis(half_width: float) -> NDArray[np.float64]:
    """Whole numbers as far from 0 as a support of `half_width` spacings reaches."""
    return np.arange(-math.ceil(half_width), math.ceil(half_width) + 1, dtype=np.float64)


def layer_field(distance: float, support_in_spacings: float, *, shifts: int = 8) -> tuple[float, float]:
    """Sum of W over one square lattice layer at a distance [spacings], and its slope.

    Averaged over so many sideways shifts along each side, as fluid beside a wall lies anywhere between its samples.
    """
    axis = _lattice_axis(support_in_spacings + 1.0)
    shift = np.arange(shifts) / shifts
    offsets = (axis[:, None] + shift[None, :]).ravel()
    in_plane = np.hypot(offsets[:, None], offsets[None, :])

    def field(height: float) -> float:
        return float(evaluate(np.hypot(in_plane, height), support_in_spacings).sum()) / shifts**2

    step = 1.0e-4
    return field(distance), (field(distance + step) - field(distance - step)) / (2.0 * step)


@dataclass(frozen=True)
class Discretization:
    """Particles of one volume on a lattice, and a kernel over them."""

    spacing: float  # of the lattice, d [m]
    support_in_spacings: float = SUPPORT_IN_SPACINGS  # support radius h of the kernel over d [-]

    @cached_property
    def support_radius(self) -> float:
        """Support radius h [m]."""
        return self.support_in_spacings * self.spacing

    @cached_property
    def inverse_support(self) -> float:
        """1/h [1/m]."""
        return 1.0 / self.support_radius

    @cached_property
    def particle_volume(self) -> float:
        """Volume V of a particle [m³]."""
        return particle_volume(self.spacing, self.support_in_spacings)

    @cached_property
    def sigma(self) -> float:
        """Factor of the kernel, 8/(pi h³) [1/m³]."""
        return normalization(self.support_radius)

    @property
    def gradient_factor(self) -> float:
        """Factor of the kernel's gradient, sigma/h [1/m⁴]."""
        return self.sigma / self.support_radius
