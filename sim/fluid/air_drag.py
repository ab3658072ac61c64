"""Drag of the air on drops and on the surface of a particle fluid (Gissler, Band, Peer, Ihmsen & Teschner 2017)."""

import math
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Vectors, on_device
from sim.core.bundles import bundle
from sim.core.drag import AIR_VISCOSITY, FLAT_DRAG, FLATTENING, drag_coefficient
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Share
from sim.core.water import TENSION_OF_WATER
from sim.fluid.kernels import Discretization, inverse_distance, lattice_offsets
from sim.fluid.parameters import FluidParameters
from sim.fluid.particles import Fluid
from sim.forces.field import ForceTable, air_at

SHEET_DRAG = 1.0  # C_D of a particle of a sheet [-]
FULL_SHARE = 2.0 / 3.0  # of a full neighbourhood, from which on a particle is part of a sheet and no drop
COVERED = 0.85
"""Cosine of the angle between the wind and the direction to the nearest neighbour from which on a particle is in
another's lee. Among a filled lattice's 26 neighbours it is at least 0.887, so that no air acts within the fluid."""


@bundle
class Air(NamedTuple):
    """The air, and the drops that single particles are in it."""

    velocity: ti.math.vec3  # [m/s]
    density: ti.f32  # [kg/m³]
    radius: ti.f32  # L of a drop of a particle's volume [m]
    spacing: ti.f32  # [m]
    flattening: Floats  # y over the square of the relative velocity, of each fluid [s²/m²], (k,)
    full: ti.f32  # neighbours from which on a particle is part of a sheet


class AirDrag:
    """Drag of air on particles, the more of it the fewer neighbours a particle has and the less these cover it.

        m_i a_i = 1/2 rho_a |v| v C_i A_i,  v = v_air - v_i

    With s the number of neighbours over 2/3 of those in a filled lattice, at most 1:

        C_i = (1 - s) C_D(Re) (1 + 2.632 y) + s,   A_i = omega [(1 - s) pi L² + s d²]

    y = We/12, at most 1, is the flattening of a drop of radius L in a steady stream, We = rho_a |v|² L/sigma, and
    omega = 1 - max_j v.(x_i - x_j)/(|v||x_ij|)/0.85, at least 0, what other particles or walls leave free.

    Other than in the paper, Re is by the diameter, as the law of the sphere has it, A that of the sphere, y that of a
    steady stream, and omega is 0 from a cosine of 0.85 on: within a filled lattice no air acts. The drag is that of
    the velocity after the step, as far as other forces are known before it, so that no step is too long for it.
    """

    def __init__(self, fluids: tuple[FluidParameters, ...], discretization: Discretization) -> None:
        """The air of these fluids, which share it."""
        first, d = fluids[0], discretization
        self._density = first.air_density
        radius = (3.0 / (4.0 * math.pi) * d.particle_volume) ** (1.0 / 3.0)
        # Where cohesion is no surface tension in N/m, drops flatten as those of water.
        tension = np.array(
            [each.surface_tension if each.surface_tension_model == "csf" else TENSION_OF_WATER for each in fluids]
        )
        tension[tension == 0.0] = TENSION_OF_WATER
        self._air = Air(
            velocity=first.wind,
            density=first.air_density,
            radius=radius,
            spacing=d.spacing,
            flattening=on_device(FLATTENING * first.air_density * radius / tension),
            full=FULL_SHARE * (len(lattice_offsets(d.support_in_spacings)) - 1),
        )
        self._reduction = LaneReduction(maxima=0, sums=3)
        self.begin_frame()

    def begin_frame(self) -> None:
        """Forget the impulse on the air so far."""
        self._reduction.partial.fill(0.0)

    def add_acceleration(self, fluid: Fluid, winds: ForceTable, acceleration: ti.Ndarray, dt: float) -> None:
        """Add the drag to all other accelerations [m/s²] of a step of dt [s], and count what the air gets.

        Winds move the air on top of its own velocity.
        """
        share = self._reduction.over(fluid.particles.count)
        add_air_drag(fluid, self._air, winds, dt, acceleration, share)

    @property
    def impulse(self) -> NDArray[np.float64]:
        """What the air got since the frame began [N s], (3,)."""
        of_lanes = copied(self._reduction.partial).astype(np.float64)
        impulse: NDArray[np.float64] = of_lanes.reshape(3, -1).sum(axis=1)
        return impulse


@kernel
def add_air_drag(fluid: Fluid, air: Air, winds: ForceTable, dt: ti.f32, acceleration: Vectors, share: Share):
    """The drag as `AirDrag` has it; each lane adds the impulse of its particles to what it had."""
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    lanes = share.tree.lanes
    for lane in range(lanes):
        impulse = ti.math.vec3(0.0)
        for item in range(share.items):
            i = lane * share.lane_step + item * share.item_step
            if i < particles.count:
                x_i, own = particles.position[i], particles.phase[i]
                wind = air.velocity + air_at(winds, own, x_i).xyz - particles.velocity[i]
                speed = wind.norm()
                downwind = wind / ti.max(speed, 1.0e-12)
                found = 0.0
                covered = 0.0
                first = near.start[i]
                for k in range(near.fluid_count[i]):
                    x_ij = x_i - particles.position[near.indices[first + k * near.stride]]
                    inverse_r = inverse_distance(x_ij.norm_sqr())
                    if inverse_r > fluid.inverse_support:
                        found += 1.0
                        covered = ti.max(covered, downwind.dot(x_ij) * inverse_r)
                first += near.fluid_count[i] * near.stride
                for k in range(near.boundary_count[i]):
                    x_ib = x_i - samples.position[near.indices[first + k * near.stride]]
                    inverse_r = inverse_distance(x_ib.norm_sqr())
                    if inverse_r > fluid.inverse_support:
                        found += 1.0
                        covered = ti.max(covered, downwind.dot(x_ib) * inverse_r)
                sheet = ti.min(found / air.full, 1.0)
                flat = ti.min(air.flattening[own] * speed * speed, 1.0)
                reynolds = 2.0 * air.radius * air.density * speed / AIR_VISCOSITY
                drop = drag_coefficient(reynolds) * (1.0 + FLAT_DRAG * flat)
                coefficient = (1.0 - sheet) * drop + sheet * SHEET_DRAG
                area = (1.0 - sheet) * ti.math.pi * air.radius * air.radius + sheet * air.spacing * air.spacing
                area *= ti.max(1.0 - covered / COVERED, 0.0)
                mass = fluid.materials.rest_density[own] * fluid.volume
                rate = 0.5 * air.density * speed * coefficient * area / mass
                a_i = rate / (1.0 + rate * dt) * (wind - dt * acceleration[i])
                acceleration[i] += a_i
                impulse -= mass * dt * a_i
        for axis in ti.static(range(3)):
            share.tree.partial[axis * lanes + lane] += impulse[axis]
