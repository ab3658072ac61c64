"""Forces from outside on the air of a smoke."""

import math

import numpy as np
import taichi as ti

from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.forces.field import ForcesOn, ForceTable, acceleration_at, air_at, drag_at, kept_off
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import Air
from sim.smoke.parameters import SmokeParameters

STANDARD_GRAVITY = 9.81  # at which smoke has the weight alpha of the parameters [m/s²]


class OutsideAir:
    """The air around a smoke's grid: it takes on the winds that blow everywhere, as that within does.

    Attributes:
        velocity: of it now [m/s].
    """

    def __init__(self, wind: Vector3, forces: ForcesOn) -> None:
        """It moves with a wind [m/s] at the start."""
        self.velocity, self._forces = wind, forces

    def advance(self, dt: float) -> None:
        """Take on the winds of the moment for dt [s]."""
        wind, rate = self._forces.even_wind()
        if rate > 0.0:
            now = np.asarray(self.velocity)
            x, y, z = (now - math.expm1(-rate * dt) * (wind - now)).tolist()
            self.velocity = x, y, z


class OuterForces:
    """What forces from outside do to open faces, beside buoyancy and gusts.

    Attractors act on smoke alone, by its density: clean air stays where pressure holds it in such a field. Gravity acts
    as that of the job does, by the weight of smoke and the lightness of heat. Air takes on the sum of the winds, and
    drag slows it, whether there is smoke in it or not.
    """

    def __init__(self, forces: ForcesOn, air: Air, parameters: SmokeParameters, grid: SmokeGrid) -> None:
        self._forces, self._air = forces, air
        self._weight = parameters.buoyancy_density / STANDARD_GRAVITY
        beta = parameters.buoyancy_temperature
        self._lightness = 1.0 / parameters.ambient_temperature if beta is None else beta / STANDARD_GRAVITY
        self._hottest = self._lightness * parameters.hottest_excess
        self._origin, self._cell_size = grid.origin, grid.cell_size
        self._cfl = parameters.cfl

    def stable_dt(self) -> float:
        """Largest step [s] in which neither winds nor what they and others accelerate cross more than `cfl` cells."""
        forces, distance = self._forces, self._cfl * self._cell_size
        acceleration = forces.largest_acceleration * max(1.0, self._hottest)
        acceleration += forces.fastest_response * forces.largest_wind
        limits = [math.sqrt(distance / acceleration)] if acceleration > 0.0 else []
        limits += [distance / forces.largest_wind] if forces.largest_wind > 0.0 else []
        return min(limits, default=math.inf)

    def accelerate(self, dt: float) -> None:
        """Change the velocities of open faces by what acts for dt [s]."""
        push_air(self._air, self._forces.now, self._origin, self._cell_size, self._weight, self._lightness, dt)


@kernel
def push_air(
    air: Air,
    forces: ForceTable,
    origin: ti.math.vec3,
    cell_size: ti.f32,
    weight: ti.f32,
    lightness: ti.f32,
    dt: ti.f32,
):
    """u += dt (rho a + (weight rho - lightness e) g) + (1 - exp(-dt/tau)) (wind - u) - (1 - exp(-k dt)) u."""
    box, openness, velocity, state = ti.static((air.box, air.openness, air.state.velocity, air.state))
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            corner = origin + cell_size * ti.math.vec3(i - 1, j - 1, k - 1)
            for axis, face, is_open in ti.static(
                ((0, velocity.x, openness.x), (1, velocity.y, openness.y), (2, velocity.z, openness.z))
            ):
                if is_open[at] > 0.0:
                    x = corner + 0.5 * cell_size
                    x[axis] = corner[axis]
                    below = at - steps(box)[axis]
                    smoke = 0.5 * (state.density[at] + state.density[below])
                    heat = 0.5 * (state.excess[at] + state.excess[below])
                    pull = smoke * acceleration_at(forces, 0, x, False)[axis]
                    pull += (weight * smoke - lightness * heat) * acceleration_at(forces, 0, x, True)[axis]
                    wind = air_at(forces, 0, x)
                    u = face[at]
                    change = dt * pull + kept_off(dt * wind.w) * (wind[axis] - u)
                    face[at] = u + change - kept_off(dt * drag_at(forces, 0, x)) * u
