"""Gusts: a random acceleration of the air that has no divergence (curl noise; Bridson, Hourihan & Nordenstam 2007)."""

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.hashed_numbers import hash_bits, hash_to_unit, spread
from sim.core.parameters import Vector3
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.parameters import CELLS_PER_EDDY, TurbulenceParameters

REACH = 4
"""Nodes of the lattice along an axis that a cell and its faces depend on."""

PEAK = 3.0
"""Largest acceleration that steps are cut for, over the root mean square: a bell curve exceeds it by chance only."""

FACE, CENTRE, SLOPE = range(3)
"""Weights of the lattice's nodes: at a lower face, at a cell's centre, and their difference across the cell."""


@ti.data_oriented
class Turbulence:
    """a = curl psi, with a vector potential psi of random values on a lattice between which it is smooth.

    psi is a sum of quadratic B-splines, so a is continuous; where the paper takes differences of smooth noise, here
    the weights of the splines are differenced over the cells, so that the flux out of every cell is zero but for
    rounding. Values at the nodes are uniform random numbers, and go from one set to the next within 1/rate by cosine
    and sine, which keeps their variance. With splines of width L (int B² = 11/20, int B'² = 1) and variance sigma² of
    the nodes the mean of |a|² is 6 (11/20)² sigma²/L².

    The pattern drifts with the wind. It is a function of place, time and seed alone.

    Args:
        grid: where the faces are.
        parameters: strength, size, rate, seed.
        wind: [m/s].
        openness: by axis, positive on faces that air passes, flat fields.
        velocity: the three face velocities [m/s], flat fields.

    Raises:
        ValueError: the eddies are smaller than cells can carry.
    """

    def __init__(
        self, grid: SmokeGrid, parameters: TurbulenceParameters, *, wind: Vector3, openness: tuple, velocity: tuple
    ) -> None:
        if parameters.size < CELLS_PER_EDDY * grid.cell_size * (1.0 - 1.0e-9):
            raise ValueError(
                f"turbulence.size: {parameters.size:g} m is less than two cells of {grid.cell_size:g} m, which carry "
                "no such eddies; enlarge it or use a smaller cell_size"
            )
        self._grid, self._parameters, self._wind = grid, parameters, wind
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._open_x, self._open_y, self._open_z = openness
        self._u, self._v, self._w = velocity
        self._lanes = lane_count()
        # Nodes that a box can reach, wherever it lies on the lattice.
        self._nodes = tuple(math.ceil(n * grid.cell_size / parameters.size) + REACH for n in grid.cells)
        self._potential = ti.Vector.field(3, ti.f32, shape=self._nodes)
        # Sums over x and y of what each face along z needs: two of a_x, two of a_y, one of a_z.
        self._rows = ti.Vector.field(5, ti.f32, shape=(self._nx + 1, self._ny + 1, self._nodes[2]))
        self._weights = tuple(ti.Vector.field(3, ti.f32, shape=(n + 1, REACH)) for n in grid.cells)
        self._firsts = tuple(ti.field(ti.i32, shape=n + 1) for n in grid.cells)
        self._origin = self._place(0.0)
        # Uniform numbers from -1 to 1 have a variance of 1/3.
        self._amplitude = parameters.strength * parameters.size / math.sqrt(6.0 * 0.55**2) * math.sqrt(3.0)

    @property
    def device_bytes(self) -> int:
        """Memory that it has allocated [bytes]; the sums of rows are nearly all of it."""
        sizes = [(self._potential, 12), (self._rows, 20), *((field, 12) for field in self._weights)]
        return sum(size * math.prod(field.shape) for field, size in sizes)

    @property
    def acceleration(self) -> float:
        """What to expect of the largest acceleration [m/s²]."""
        return PEAK * self._parameters.strength

    def accelerate(self, time_s: float, dt: float) -> None:
        """Add dt [s] times the acceleration at a simulated time [s] to the velocities of open faces."""
        if any(self._wind):
            self._origin = self._place(time_s)
        phase = time_s * self._parameters.rate
        tick = math.floor(phase)
        turn = 0.5 * math.pi * (phase - tick)
        self._draw(
            ti.Vector(self._origin), tick, spread(self._parameters.seed),
            self._amplitude * math.cos(turn), self._amplitude * math.sin(turn),
        )  # fmt: skip
        self._sum_rows()
        self._apply(dt)

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
            self._weights[axis].from_numpy(weights.astype(np.float32))
            self._firsts[axis].from_numpy((nearest[:-1] - 1 - first).astype(np.int32))
        return origin

    @ti.kernel
    def _draw(self, origin: ti.math.ivec3, tick: ti.i32, salt: ti.u32, now: ti.f32, later: ti.f32):
        """Random vectors at the nodes, between those of two ticks."""
        for i, j, k in self._potential:
            place = origin + ti.Vector([i, j, k])
            key = salt
            for axis in ti.static(range(3)):
                key = hash_bits(key ^ ti.cast(place[axis], ti.u32))
            for axis in ti.static(range(3)):
                numbers = ti.Vector([0.0, 0.0])
                for step in ti.static(range(2)):
                    moment = ti.cast(3 * (tick + step) + axis, ti.u32)
                    numbers[step] = 2.0 * hash_to_unit(hash_bits(key ^ moment)) - 1.0
                self._potential[i, j, k][axis] = now * numbers[0] + later * numbers[1]

    @ti.kernel
    def _sum_rows(self):
        for i, j, k in self._rows:
            total = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0])
            first_x, first_y = self._firsts[0][i], self._firsts[1][j]
            for a in range(REACH):
                x = self._weights[0][i, a]
                for b in range(REACH):
                    y = self._weights[1][j, b]
                    psi = self._potential[first_x + a, first_y + b, k]
                    total += ti.Vector(
                        [
                            x[FACE] * y[SLOPE] * psi[2],
                            x[FACE] * y[CENTRE] * psi[1],
                            x[CENTRE] * y[FACE] * psi[0],
                            x[SLOPE] * y[FACE] * psi[2],
                            x[SLOPE] * y[CENTRE] * psi[1] - x[CENTRE] * y[SLOPE] * psi[0],
                        ]
                    )
            self._rows[i, j, k] = total

    @ti.kernel
    def _apply(self, dt: ti.f32):
        for i, j, lane in ti.ndrange((1, self._nx + 2), (1, self._ny + 2), self._lanes):
            row = i * self._step_x + j * self._step_y
            for n in range(lane_items(self._nz + 1, lane)):
                k = lane_place(n, lane)
                at = row + k
                first = self._firsts[2][k - 1]
                a_x, a_y, a_z = 0.0, 0.0, 0.0
                for c in range(REACH):
                    z = self._weights[2][k - 1, c]
                    sums = self._rows[i - 1, j - 1, first + c]
                    a_x += z[CENTRE] * sums[0] - z[SLOPE] * sums[1]
                    a_y += z[SLOPE] * sums[2] - z[CENTRE] * sums[3]
                    a_z += z[FACE] * sums[4]
                self._u[at] += ti.select(self._open_x[at] > 0.0, dt * a_x, 0.0)
                self._v[at] += ti.select(self._open_y[at] > 0.0, dt * a_y, 0.0)
                self._w[at] += ti.select(self._open_z[at] > 0.0, dt * a_z, 0.0)


def _spline(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quadratic B-spline of a distance in widths [-]."""
    away = np.abs(distance)
    return np.where(away < 0.5, 0.75 - away**2, 0.5 * np.clip(1.5 - away, 0.0, None) ** 2)
