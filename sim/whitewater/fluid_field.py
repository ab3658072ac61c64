"""The fluid at one moment, sorted into cells: its normals, its potentials, and its flow at any points."""

import math
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Matrices, Vectors, on_device
from sim.core.bundles import bundle
from sim.core.cells import CellGrid, CellSort, Grid, cell_of_point, row_of_cell
from sim.core.launch import kernel
from sim.whitewater.motion import FluidState

SUPPORT_IN_SPACINGS = 2.0  # support radius h over the lattice spacing, as in the simulation
FULL_NEIGHBORHOOD = 4.0 / 3.0 * math.pi * SUPPORT_IN_SPACINGS**3  # particles within h of a point in the bulk: 33.5

# Integrals of W = 1 - r/h over a ball and over a disc: a quarter and a third of their sizes.
_FULL_WEIGHT = FULL_NEIGHBORHOOD / 4.0
_FULL_SURFACE_WEIGHT = math.pi * SUPPORT_IN_SPACINGS**2 / 3.0

_ANYWHERE = (-3.0e38,) * 3, (3.0e38,) * 3

TINY = 1.0e-6  # two particles closer than this share of h have no direction to each other
SURFACE_ASYMMETRY = 0.25
"""Length of the mean weighted direction away from the neighbours from which a particle counts as one of the surface:
0 in the bulk, 0.53 on the flat face of a lattice, 0.2 in the layer below, up to 1 beyond."""

CREST_DIRECTION = 0.6  # least cosine between velocity and normal on a crest (eq. 6): waves move against their surface


class Neighborhoods(NamedTuple):
    """What is around the particles of a fluid."""

    neighbors: NDArray[np.int32]  # within h, (n,)
    covariance: NDArray[np.float32]  # weighted covariance of their places [m²], (n, 3, 3)
    touches_crowd: NDArray[np.bool_]  # whether a crowded particle is linked to it, (n,); True for those themselves


class FluidField:
    """Fluid at one moment after the other; `sim.core.runtime.initialize` must have run.

    Attributes:
        support_radius: h [m].
    """

    def __init__(self, bounds: NDArray[np.floating], particle_radius: float, capacity: int) -> None:
        """Make room for particles of this radius [m] in a box [m], (2, 3), which they may leave a little."""
        self.support_radius = SUPPORT_IN_SPACINGS * 2.0 * particle_radius
        self._grid = CellGrid.covering(bounds[0], bounds[1], self.support_radius)
        self._cells = CellSort(self._grid, capacity)
        self._order = np.zeros(0, np.int32)
        self._fluid: Fluid | None = None

    def update(self, state: FluidState) -> None:
        """Take the fluid's particles as they are now."""
        count = len(state.position)
        self._order, self._fluid = np.zeros(0, np.int32), None
        if not count:
            return
        self._cells.sort(on_device(state.position), on_device(state.particle_id), count, *_ANYWHERE)
        self._order = self._cells.order.to_numpy()[:count]
        self._fluid = Fluid(
            on_device(state.position[self._order]),
            on_device(state.velocity[self._order]),
            count,
            self._cells.cell_start,
            self._grid.on_device,
            self.support_radius,
        )

    def potentials(self, min_speed: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Trapped air [m/s] and wave crest [-] of every particle, (n,) each, in the order of `update`.

        Both are 0 for particles slower than `min_speed` [m/s]. See `compute_potentials`.
        """
        count = len(self._order)
        trapped_air, wave_crest = np.zeros(count, np.float32), np.zeros(count, np.float32)
        if self._fluid is None:
            return trapped_air, wave_crest
        normal = ti.Vector.ndarray(3, ti.f32, count)
        compute_normals(self._fluid, normal)
        air, crest = ti.ndarray(ti.f32, count), ti.ndarray(ti.f32, count)
        compute_potentials(self._fluid, normal, min_speed, _FULL_WEIGHT, _FULL_SURFACE_WEIGHT, air, crest)
        trapped_air[self._order], wave_crest[self._order] = air.to_numpy(), crest.to_numpy()
        return trapped_air, wave_crest

    def neighborhoods(self, crowd: int, link: float) -> Neighborhoods:
        """What is around every particle, in the order of `update`.

        One with `crowd` neighbours or more is crowded; whether such a one is within `link` [m] of the others is told,
        too. See `compute_neighborhoods`.
        """
        count = len(self._order)
        result = Neighborhoods(np.zeros(count, np.int32), np.zeros((count, 3, 3), np.float32), np.zeros(count, bool))
        if self._fluid is None:
            return result
        neighbors, covariance = ti.ndarray(ti.i32, count), ti.Matrix.ndarray(3, 3, ti.f32, count)
        touches = ti.ndarray(ti.i32, count)
        compute_neighborhoods(self._fluid, neighbors, covariance)
        find_crowds(self._fluid, neighbors, crowd, link, touches)
        result.neighbors[self._order], result.covariance[self._order] = neighbors.to_numpy(), covariance.to_numpy()
        result.touches_crowd[self._order] = touches.to_numpy() != 0
        return result

    def sample(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Velocity of the fluid at points (n, 3) [m/s], (n, 3), and the number of its particles within h, (n,)."""
        count = len(points)
        if not count or self._fluid is None:
            return np.zeros((count, 3), np.float32), np.zeros(count, np.int32)
        flow, neighbors = ti.Vector.ndarray(3, ti.f32, count), ti.ndarray(ti.i32, count)
        sample_flow(on_device(points), count, self._fluid, flow, neighbors)
        return flow.to_numpy(), neighbors.to_numpy()


@bundle
class Fluid(NamedTuple):
    """Particles of the fluid, sorted by cells as wide as h."""

    x: Vectors  # positions [m], (n,)
    v: Vectors  # velocities [m/s], (n,)
    count: ti.i32
    cell_start: Integers  # first particle of each cell, (cells + 2,)
    grid: Grid
    h: ti.f32  # support radius [m]


@kernel
def compute_normals(fluid: Fluid, normal: Vectors):
    """Unit normal out of the fluid of each surface particle, zero for the others.

    n_i = sum_j W_ij x_ij/|x_ij| / sum_j W_ij, kept where it is longer than `SURFACE_ASYMMETRY`.
    """
    closest_squared = (TINY * fluid.h) ** 2
    for i in range(fluid.count):
        x_i = fluid.x[i]
        cell = cell_of_point(x_i, fluid.grid)
        n_i = ti.math.vec3(0.0)
        weight = 0.0
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                row = row_of_cell(cell, dy, dz, fluid.grid)
                for j in range(fluid.cell_start[row - 1], fluid.cell_start[row + 2]):
                    x_ij = x_i - fluid.x[j]
                    r_squared = x_ij.norm_sqr()
                    if r_squared < fluid.h * fluid.h and r_squared > closest_squared:
                        r = ti.sqrt(r_squared)
                        W_ij = 1.0 - r / fluid.h
                        n_i += W_ij / r * x_ij
                        weight += W_ij
        length = n_i.norm()
        if length > SURFACE_ASYMMETRY * weight and weight > 0.0:
            normal[i] = n_i / length
        else:
            normal[i] = ti.math.vec3(0.0)


@kernel
def compute_potentials(
    fluid: Fluid,
    normal: Vectors,
    min_speed: ti.f32,
    full_weight: ti.f32,
    full_surface_weight: ti.f32,
    trapped_air: Floats,
    wave_crest: Floats,
):
    """Trapped air [m/s] and wave crest [-] of each particle that is faster than `min_speed`, 0 for the others.

    Trapped air (eq. 2): sum_j |v_ij| (1 - v_ij/|v_ij| . x_ij/|x_ij|) W_ij, over twice the weight of a full
    neighbourhood: the mean speed at which neighbours close in, if they do so head on.
    Wave crest (eq. 4-6): sum_j (1 - n_i . n_j) W_ij over surface neighbours below the tangent plane, over the weight of
    a full disc of them, where the particle moves outwards.
    """
    closest_squared = (TINY * fluid.h) ** 2
    for i in range(fluid.count):
        x_i, v_i, n_i = fluid.x[i], fluid.v[i], normal[i]
        closing = 0.0
        curvature = 0.0
        speed = v_i.norm()
        if speed > min_speed:
            on_crest = n_i.norm_sqr() > 0.5 and v_i.dot(n_i) >= CREST_DIRECTION * speed
            cell = cell_of_point(x_i, fluid.grid)
            for dz in range(-1, 2):
                for dy in range(-1, 2):
                    row = row_of_cell(cell, dy, dz, fluid.grid)
                    for j in range(fluid.cell_start[row - 1], fluid.cell_start[row + 2]):
                        x_ij = x_i - fluid.x[j]
                        r_squared = x_ij.norm_sqr()
                        if r_squared < fluid.h * fluid.h and r_squared > closest_squared:
                            r = ti.sqrt(r_squared)
                            W_ij = 1.0 - r / fluid.h
                            v_ij = v_i - fluid.v[j]
                            closing += (v_ij.norm() - v_ij.dot(x_ij) / r) * W_ij
                            n_j = normal[j]
                            if on_crest and n_j.norm_sqr() > 0.5 and x_ij.dot(n_i) > 0.0:
                                curvature += (1.0 - n_i.dot(n_j)) * W_ij
        trapped_air[i] = 0.5 * closing / full_weight
        wave_crest[i] = curvature / full_surface_weight


@kernel
def compute_neighborhoods(fluid: Fluid, neighbors: Integers, covariance: Matrices):
    """Number of particles within h of each, and the weighted covariance of their places, the particle's own included.

    C_i = sum_j w_ij (x_j - x~)(x_j - x~)^T / sum_j w_ij about the weighted mean x~, w_ij = 1 - (|x_ij|/h)³ (Yu & Turk
    2013, eq. 9 to 11).
    """
    for i in range(fluid.count):
        x_i = fluid.x[i]
        cell = cell_of_point(x_i, fluid.grid)
        near = 0
        weight = 0.0
        first = ti.math.vec3(0.0)
        second = ti.math.mat3(0.0)
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                row = row_of_cell(cell, dy, dz, fluid.grid)
                for j in range(fluid.cell_start[row - 1], fluid.cell_start[row + 2]):
                    x_ji = fluid.x[j] - x_i
                    r_squared = x_ji.norm_sqr()
                    if r_squared < fluid.h * fluid.h:
                        q = ti.sqrt(r_squared) / fluid.h
                        w = 1.0 - q * q * q
                        near += 1
                        weight += w
                        first += w * x_ji
                        second += w * x_ji.outer_product(x_ji)
        mean = first / weight
        neighbors[i] = near - 1
        covariance[i] = second / weight - mean.outer_product(mean)


@kernel
def find_crowds(fluid: Fluid, neighbors: Integers, crowd: ti.i32, link: ti.f32, touches: Integers):
    """1 for particles that have `crowd` neighbours or more, or such a particle within `link` [m]; 0 for the others."""
    for i in range(fluid.count):
        x_i = fluid.x[i]
        found = 0
        if neighbors[i] >= crowd:
            found = 1
        else:
            cell = cell_of_point(x_i, fluid.grid)
            for dz in range(-1, 2):
                for dy in range(-1, 2):
                    row = row_of_cell(cell, dy, dz, fluid.grid)
                    for j in range(fluid.cell_start[row - 1], fluid.cell_start[row + 2]):
                        if neighbors[j] >= crowd and (fluid.x[j] - x_i).norm_sqr() <= link * link:
                            found = 1
        touches[i] = found


@kernel
def sample_flow(points: Vectors, point_count: ti.i32, fluid: Fluid, flow: Vectors, neighbors: Integers):
    """Velocity of the fluid at points, and how many fluid particles are within h of each.

    v~ = sum_f v_f K(x - x_f) / sum_f K(x - x_f) (eq. 8), K the cubic spline; zero where there is no fluid.
    """
    for p in range(point_count):
        x_p = points[p]
        cell = cell_of_point(x_p, fluid.grid)
        momentum = ti.math.vec3(0.0)
        weight = 0.0
        near = 0
        for dz in range(-1, 2):
            for dy in range(-1, 2):
                row = row_of_cell(cell, dy, dz, fluid.grid)
                for j in range(fluid.cell_start[row - 1], fluid.cell_start[row + 2]):
                    r_squared = (x_p - fluid.x[j]).norm_sqr()
                    if r_squared < fluid.h * fluid.h:
                        q = ti.sqrt(r_squared) / fluid.h
                        K = 2.0 * (1.0 - q) ** 3
                        if q < 0.5:
                            K = 1.0 - 6.0 * q * q * (1.0 - q)
                        momentum += K * fluid.v[j]
                        weight += K
                        near += 1
        flow[p] = ti.math.vec3(0.0)
        # A single particle just inside h weighs so little that dividing by it would overflow.
        if weight > 1.0e-20:
            flow[p] = momentum / weight
        neighbors[p] = near
