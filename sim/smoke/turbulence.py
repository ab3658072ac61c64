"""Gusts: a random acceleration of the air that has no divergence (curl noise; Bridson, Hourihan & Nordenstam 2007)."""

import math
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import bundle
from sim.core.hashed_numbers import hash_bits, hash_to_unit, spread
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import Grid, lane_items, lane_place, row_start
from sim.smoke.obstacles import Air
from sim.smoke.parameters import CELLS_PER_EDDY, TurbulenceParameters

REACH = 4  # nodes of the lattice along an axis that a cell and its faces depend on
PEAK = 3.0  # largest acceleration that steps are cut for, over the root mean square: exceeded by chance only
SUMS = 5  # numbers that a face along z needs of a row of the lattice
FACE, CENTRE, SLOPE = range(3)  # weights of nodes: at a lower face, at a cell's centre, the difference across the cell


@bundle
class Lattice(NamedTuple):
    """Nodes of random vectors around a box, and the weights by which cells and faces depend on them."""

    nodes_x: ti.i32
    nodes_y: ti.i32
    nodes_z: ti.i32
    potential: Vectors  # at the nodes, in C order
    sums: Floats  # over x and y of what each face along z needs: two of a_x, two of a_y, one of a_z
    firsts_x: Integers  # first node of a cell and its lower face
    firsts_y: Integers
    firsts_z: Integers
    weights_x: Vectors  # `REACH` of each cell, by FACE, CENTRE, SLOPE
    weights_y: Vectors
    weights_z: Vectors


class Turbulence:
    """a = curl psi, with a vector potential psi of random values on a lattice between which it is smooth.

    psi is a sum of quadratic B-splines, so a is continuous; where the paper takes differences of smooth noise, here
    the weights of the splines are differenced over the cells, so that the flux out of every cell is zero but for
    rounding. Values at the nodes are uniform random numbers, and go from one set to the next within 1/rate by cosine
    and sine, which keeps their variance. With splines of width L (int B² = 11/20, int B'² = 1) and variance sigma² of
    the nodes the mean of |a|² is 6 (11/20)² sigma²/L².

    The pattern drifts with the wind. It is a function of place, time and seed alone.

    Raises:
        ValueError: the eddies are smaller than cells can carry.
    """

    def __init__(self, grid: SmokeGrid, parameters: TurbulenceParameters, wind: Vector3) -> None:
        if parameters.size < CELLS_PER_EDDY * grid.cell_size * (1.0 - 1.0e-9):
            raise ValueError(
                f"turbulence.size: {parameters.size:g} m is less than two cells of {grid.cell_size:g} m, which carry "
                "no such eddies; enlarge it or use a smaller cell_size"
            )
        self._grid, self._parameters, self._wind = grid, parameters, wind
        # Nodes that a box can reach, wherever it lies on the lattice.
        nodes = [math.ceil(n * grid.cell_size / parameters.size) + REACH for n in grid.cells]
        self._lattice = Lattice(
            *nodes,
            ti.Vector.ndarray(3, ti.f32, math.prod(nodes)),
            ti.ndarray(ti.f32, SUMS * (grid.cells[0] + 1) * (grid.cells[1] + 1) * nodes[2]),
            *(ti.ndarray(ti.i32, n + 1) for n in grid.cells),
            *(ti.Vector.ndarray(3, ti.f32, REACH * (n + 1)) for n in grid.cells),
        )
        self._origin = self._place(0.0)
        # Uniform numbers from -1 to 1 have a variance of 1/3.
        self._amplitude = parameters.strength * parameters.size / math.sqrt(6.0 * 0.55**2) * math.sqrt(3.0)

    @property
    def acceleration(self) -> float:
        """What to expect of the largest acceleration [m/s²]."""
        return PEAK * self._parameters.strength

    def accelerate(self, air: Air, time_s: float, dt: float) -> None:
        """Add dt [s] times the acceleration at a simulated time [s] to the velocities of open faces."""
        if any(self._wind):
            self._origin = self._place(time_s)
        phase = time_s * self._parameters.rate
        tick = math.floor(phase)
        turn = 0.5 * math.pi * (phase - tick)
        now, later = self._amplitude * math.cos(turn), self._amplitude * math.sin(turn)
        salt = int(np.uint32(spread(self._parameters.seed)).view(np.int32))
        _draw(self._lattice, ti.math.ivec3(self._origin), tick, salt, now, later)
        _sum_rows(air.box, self._lattice)
        _apply(air, self._lattice, dt)

    def _place(self, time_s: float) -> list[int]:
        """Set the weights of all faces and cells for a lattice that has drifted so long [s]; returns its first node."""
        origin = []
        grid = self._grid
        for axis, (n, low) in enumerate(zip(grid.cells, grid.origin, strict=True)):
            faces = (low + np.arange(n + 2) * grid.cell_size - self._wind[axis] * time_s) / self._parameters.size
            nearest = np.floor(faces + 0.5).astype(np.int64)
            weights = np.zeros((n + 1, REACH, 3))
            for node in range(REACH):
                at = nearest[:-1] - 1 + node
                weights[:, node, FACE] = _spline(faces[:-1] - at)
                weights[:, node, CENTRE] = _spline(0.5 * (faces[:-1] + faces[1:]) - at)
                weights[:, node, SLOPE] = (_spline(faces[1:] - at) - _spline(faces[:-1] - at)) / grid.cell_size
            first = int(nearest[0]) - 1
            origin.append(first)
            firsts_of, weights_of = (getattr(self._lattice, f"{name}_{'xyz'[axis]}") for name in ("firsts", "weights"))
            firsts_of.from_numpy((nearest[:-1] - 1 - first).astype(np.int32))
            weights_of.from_numpy(weights.reshape(-1, 3).astype(np.float32))
        return origin


@kernel
def _draw(lattice: Lattice, origin: ti.math.ivec3, tick: ti.i32, salt: ti.i32, now: ti.f32, later: ti.f32):
    """Random vectors at the nodes, between those of two ticks."""
    for i, j, k in ti.ndrange(lattice.nodes_x, lattice.nodes_y, lattice.nodes_z):
        place = origin + ti.Vector([i, j, k])
        key = ti.cast(salt, ti.u32)
        for axis in ti.static(range(3)):
            key = hash_bits(key ^ ti.cast(place[axis], ti.u32))
        value = ti.math.vec3(0.0)
        for axis in ti.static(range(3)):
            numbers = ti.Vector([0.0, 0.0])
            for step in ti.static(range(2)):
                moment = ti.cast(3 * (tick + step) + axis, ti.u32)
                numbers[step] = 2.0 * hash_to_unit(hash_bits(key ^ moment)) - 1.0
            value[axis] = now * numbers[0] + later * numbers[1]
        lattice.potential[(i * lattice.nodes_y + j) * lattice.nodes_z + k] = value


@kernel
def _sum_rows(box: Grid, lattice: Lattice):
    for i, j, k in ti.ndrange(box.nx + 1, box.ny + 1, lattice.nodes_z):
        total = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0])
        for a in range(REACH):
            x = lattice.weights_x[REACH * i + a]
            plane = (lattice.firsts_x[i] + a) * lattice.nodes_y
            for b in range(REACH):
                y = lattice.weights_y[REACH * j + b]
                psi = lattice.potential[(plane + lattice.firsts_y[j] + b) * lattice.nodes_z + k]
                total += ti.Vector(
                    [
                        x[FACE] * y[SLOPE] * psi[2],
                        x[FACE] * y[CENTRE] * psi[1],
                        x[CENTRE] * y[FACE] * psi[0],
                        x[SLOPE] * y[FACE] * psi[2],
                        x[SLOPE] * y[CENTRE] * psi[1] - x[CENTRE] * y[SLOPE] * psi[0],
                    ]
                )
        for n in ti.static(range(SUMS)):
            lattice.sums[SUMS * ((i * (box.ny + 1) + j) * lattice.nodes_z + k) + n] = total[n]


@kernel
def _apply(air: Air, lattice: Lattice, dt: ti.f32):
    box, openness, velocity = ti.static((air.box, air.openness, air.state.velocity))
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        first_sum = ((i - 1) * (box.ny + 1) + j - 1) * lattice.nodes_z
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            a_x, a_y, a_z = 0.0, 0.0, 0.0
            for c in range(REACH):
                z = lattice.weights_z[REACH * (k - 1) + c]
                sums = SUMS * (first_sum + lattice.firsts_z[k - 1] + c)
                a_x += z[CENTRE] * lattice.sums[sums] - z[SLOPE] * lattice.sums[sums + 1]
                a_y += z[SLOPE] * lattice.sums[sums + 2] - z[CENTRE] * lattice.sums[sums + 3]
                a_z += z[FACE] * lattice.sums[sums + 4]
            velocity.x[at] += ti.select(openness.x[at] > 0.0, dt * a_x, 0.0)
            velocity.y[at] += ti.select(openness.y[at] > 0.0, dt * a_y, 0.0)
            velocity.z[at] += ti.select(openness.z[at] > 0.0, dt * a_z, 0.0)


def _spline(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quadratic B-spline of a distance in widths [-]."""
    away = np.abs(distance)
    return np.where(away < 0.5, 0.75 - away**2, 0.5 * np.clip(1.5 - away, 0.0, None) ** 2)
