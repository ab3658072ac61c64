"""Buoyancy and vorticity confinement (Fedkiw, Stam & Jensen 2001, eq. 8-11)."""

import math

import numpy as np
import taichi as ti

from sim.core.parameters import Vector3
from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.obstacles import Obstacles

TINY_GRADIENT = 1.0e-6
"""Keeps N = eta / (|eta| + tiny) finite where the vorticity is even [1/(m s)]."""


def upward(gravity: Vector3) -> tuple[float, float, float]:
    """Unit vector against gravity; zero without gravity, where nothing rises."""
    strength = math.sqrt(sum(g * g for g in gravity))
    x, y, z = (-g / strength if strength > 0.0 else 0.0 for g in gravity)
    return x, y, z


@ti.data_oriented
class Forces:
    """Accelerates the air: f = (-alpha rho + beta (T - T_air)) up + epsilon h (N x omega).

    The confinement is evaluated at cell centres, three cells and more away from the sides of the box, where the
    gradient of the vorticity is not made up by the boundary, and averaged onto faces.

    Args:
        obstacles: in the grid where the fields live; closed faces get the velocity of the solid behind them.
        openness: by axis, positive on faces that air passes, flat fields.
        velocity: the three face velocities [m/s], flat fields.
        cell_fields: density and temperature excess, flat fields.
        work: four flat fields to work in.
        gravity: [m/s²]; only its direction matters, as alpha and beta are accelerations.
        buoyancy_density: alpha [m/s²].
        buoyancy_temperature: beta [m/(s² K)].
        confinement: epsilon [1/s]: with h [m] and omega [1/s] its force is an acceleration.
    """

    def __init__(
        self,
        obstacles: Obstacles,
        *,
        openness: tuple,
        velocity: tuple,
        cell_fields: tuple,
        work: tuple,
        gravity: Vector3,
        buoyancy_density: float,
        buoyancy_temperature: float,
        confinement: float,
    ) -> None:
        grid = obstacles.grid
        self._obstacles = obstacles
        self._lanes = lane_count()
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._size = grid.size
        self._open_x, self._open_y, self._open_z = openness
        self._u, self._v, self._w = velocity
        self._density, self._excess = cell_fields
        self._f_x, self._f_y, self._f_z, self._vorticity = work
        up = np.asarray(upward(gravity))
        self._sink = tuple((-buoyancy_density * up).tolist())
        self._lift = tuple((buoyancy_temperature * up).tolist())
        self._half_per_cell = 0.5 / grid.cell_size
        self._strength = confinement * grid.cell_size

    def accelerate(self, dt: float) -> None:
        """Add dt [s] times the acceleration to open faces; on closed ones air moves as the solid does."""
        self._clear_confinement()
        if self._strength > 0.0:
            self._compute_vorticity()
            self._compute_confinement()
        self._apply(dt)

    @ti.func
    def _centre(self, face: ti.template(), step: ti.template(), at: ti.i32):
        return 0.5 * (face[at] + face[at + step])

    @ti.kernel
    def _clear_confinement(self):
        for at in range(self._size):
            self._f_x[at] = 0.0
            self._f_y[at] = 0.0
            self._f_z[at] = 0.0
            self._vorticity[at] = 0.0

    @ti.kernel
    def _compute_vorticity(self):
        """omega = curl u by central differences of cell-centred velocities [1/s]."""
        for i, j, lane in ti.ndrange((2, self._nx), (2, self._ny), self._lanes):
            row = i * self._step_x + j * self._step_y
            for n in range(lane_items(self._nz - 2, lane)):
                at = row + 1 + lane_place(n, lane)
                x, y, z = ti.static(self._step_x, self._step_y, 1)
                omega_x = (self._centre(self._w, z, at + y) - self._centre(self._w, z, at - y)) - (
                    self._centre(self._v, y, at + z) - self._centre(self._v, y, at - z)
                )
                omega_y = (self._centre(self._u, x, at + z) - self._centre(self._u, x, at - z)) - (
                    self._centre(self._w, z, at + x) - self._centre(self._w, z, at - x)
                )
                omega_z = (self._centre(self._v, y, at + x) - self._centre(self._v, y, at - x)) - (
                    self._centre(self._u, x, at + y) - self._centre(self._u, x, at - y)
                )
                omega_x *= self._half_per_cell
                omega_y *= self._half_per_cell
                omega_z *= self._half_per_cell
                self._f_x[at] = omega_x
                self._f_y[at] = omega_y
                self._f_z[at] = omega_z
                self._vorticity[at] = ti.sqrt(omega_x * omega_x + omega_y * omega_y + omega_z * omega_z)

    @ti.kernel
    def _compute_confinement(self):
        """Replace omega by epsilon h (N x omega), N = eta / |eta|, eta = grad |omega| [m/s²]."""
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            inner_row = 2 < i < self._nx - 1 and 2 < j < self._ny - 1
            for n in range(lane_items(self._nz, lane)):
                k = lane_place(n, lane)
                at = row + k
                x, y, z = ti.static(self._step_x, self._step_y, 1)
                eta_x = self._half_per_cell * (self._vorticity[at + x] - self._vorticity[at - x])
                eta_y = self._half_per_cell * (self._vorticity[at + y] - self._vorticity[at - y])
                eta_z = self._half_per_cell * (self._vorticity[at + z] - self._vorticity[at - z])
                length = ti.sqrt(eta_x * eta_x + eta_y * eta_y + eta_z * eta_z)
                scale = ti.select(inner_row and 2 < k < self._nz - 1, self._strength / (length + TINY_GRADIENT), 0.0)
                omega_x, omega_y, omega_z = self._f_x[at], self._f_y[at], self._f_z[at]
                self._f_x[at] = scale * (eta_y * omega_z - eta_z * omega_y)
                self._f_y[at] = scale * (eta_z * omega_x - eta_x * omega_z)
                self._f_z[at] = scale * (eta_x * omega_y - eta_y * omega_x)

    @ti.kernel
    def _apply(self, dt: ti.f32):
        # Ghost cells have no density, no excess and no confinement: half of what the cell inside has acts on a side.
        for i, j, lane in ti.ndrange((1, self._nx + 2), (1, self._ny + 2), self._lanes):
            row = i * self._step_x + j * self._step_y
            for n in range(lane_items(self._nz + 1, lane)):
                at = row + lane_place(n, lane)
                f_x = self._force(self._f_x, 0, at) + self._force(self._f_x, 0, at - self._step_x)
                f_y = self._force(self._f_y, 1, at) + self._force(self._f_y, 1, at - self._step_y)
                f_z = self._force(self._f_z, 2, at) + self._force(self._f_z, 2, at - 1)
                self._u[at] = self._accelerated(self._open_x, self._u, 0, at, 0.5 * dt * f_x)
                self._v[at] = self._accelerated(self._open_y, self._v, 1, at, 0.5 * dt * f_y)
                self._w[at] = self._accelerated(self._open_z, self._w, 2, at, 0.5 * dt * f_z)

    @ti.func
    def _accelerated(self, openness: ti.template(), face: ti.template(), axis: ti.template(), at: ti.i32, gain: ti.f32):
        velocity = face[at] + gain
        if openness[at] == 0.0:
            velocity = self._obstacles.face_velocity(axis, at)
        return velocity

    @ti.func
    def _force(self, confinement: ti.template(), axis: ti.template(), at: ti.i32):
        return confinement[at] + self._sink[axis] * self._density[at] + self._lift[axis] * self._excess[at]
