"""Whitewater from one cached frame to the next (Ihmsen et al. 2012: "Unified spray, foam and air bubbles")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.core.drag import drag_rate
from sim.core.parameters import Vector3
from sim.whitewater.cloud import WhitewaterCloud, WhitewaterKind
from sim.whitewater.fluid_field import FluidField
from sim.whitewater.generation import generate, generation_rate
from sim.whitewater.motion import FluidMotion, FluidState
from sim.whitewater.obstacles import MovingObstacle, Obstacles
from sim.whitewater.parameters import WhitewaterParameters

MAX_SUBSTEPS = 64  # A frame has as many substeps as support radii that the fastest fluid goes, up to this

Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class WhitewaterReport:
    """What a frame did."""

    substeps: int  # into which it was divided
    generated: int  # new particles
    not_generated: int  # particles that there was no room for


class WhitewaterSolver:
    """Advances whitewater through a fluid that is known already; `sim.core.runtime.initialize` must have run.

    It keeps no state between frames: all that the next frame needs is in the cloud and the frames of the fluid.
    """

    def __init__(
        self,
        parameters: WhitewaterParameters,
        *,
        domain: DomainParameters,
        gravity: Vector3,
        frames_per_second: float,
        rest_density: float = 1000.0,
    ) -> None:
        """`rest_density` is that of the fluid that the whitewater is made of [kg/m³]."""
        self._parameters, self._domain = parameters, domain
        self._rest_density = rest_density
        self._gravity = np.asarray(gravity, np.float64)
        self._frame_dt = 1.0 / frames_per_second

    def advance_frame(
        self,
        cloud: WhitewaterCloud,
        begin: FluidState,
        end: FluidState,
        *,
        frame: int,
        particle_radius: float,
        bodies: Sequence[MovingObstacle] = (),
        sources: NDArray[np.int32] | None = None,
    ) -> tuple[WhitewaterCloud, WhitewaterReport]:
        """The cloud of a frame, from that of the frame before.

        All fluids of the tank, of one particle radius [m], go from `begin` to `end`, and bodies with them. Particles of
        the ids in `sources`, those of one fluid, (n,), make whitewater; all if omitted. The others are around them like
        their own: under another fluid there is neither a crest nor spray.
        """
        motion = FluidMotion(begin, end, self._frame_dt)
        field = FluidField(motion.bounds(), particle_radius, len(end.position))
        obstacles = Obstacles(self._domain, bodies, self._frame_dt)
        crossed = motion.max_speed() * self._frame_dt / field.support_radius
        substeps = min(max(1, math.ceil(crossed)), MAX_SUBSTEPS)
        dt = self._frame_dt / substeps
        is_source = None if sources is None else np.isin(motion.particle_id, sources)
        generated = not_generated = 0
        for substep in range(substeps):
            share = (substep + 1) / substeps
            fluid = motion.at(share)
            field.update(fluid)
            cloud = self._move(cloud, field, obstacles, share, dt)
            room = max(0, self._parameters.max_particles - len(cloud))
            rate = generation_rate(fluid.velocity, *field.potentials(self._parameters.min_speed), self._parameters)
            rate = rate if is_source is None else np.where(is_source, rate, 0.0)
            moment, parameters = (frame, substep), self._parameters
            born, missed = generate(
                fluid, rate, dt, particle_radius=particle_radius, room=room, moment=moment, parameters=parameters
            )
            cloud = cloud.joined(self._settled(born, field, obstacles, share))
            generated, not_generated = generated + len(born), not_generated + missed
        return cloud, WhitewaterReport(substeps, generated, not_generated)

    def _move(
        self, cloud: WhitewaterCloud, field: FluidField, obstacles: Obstacles, share: float, dt: float
    ) -> WhitewaterCloud:
        """Advect every particle as what it is, take it out of solids, let it age."""
        if len(cloud) == 0:
            return cloud
        position, velocity = cloud.position.astype(np.float64), cloud.velocity.astype(np.float64)
        ahead = position + dt * velocity
        flow, neighbors = field.sample(ahead.astype(np.float32))
        kind = self._classify(neighbors, obstacles.free_share(ahead, field.support_radius, share))
        drag = drag_rate(
            velocity,
            cloud.radius.astype(np.float64),
            air_density=self._parameters.air_density,
            rest_density=self._rest_density,
        )
        moved, velocity = self._advect(position, velocity, flow.astype(np.float64), drag, cloud.kind, kind, dt)
        moved, velocity, touched, stays = obstacles.collide(moved, velocity, share)
        # Bubbles live on until they surface, and spray while it flies; spray that lies on a solid dries up.
        ages = (kind == WhitewaterKind.FOAM) | ((kind == WhitewaterKind.SPRAY) & touched)
        lifetime = cloud.lifetime - np.where(ages, np.float32(dt), np.float32(0.0))
        advanced = WhitewaterCloud(
            moved.astype(np.float32), velocity.astype(np.float32), cloud.radius, lifetime.astype(np.float32), kind
        )
        return advanced.kept(stays & (lifetime > 0.0))

    def _classify(self, neighbors: NDArray[np.int32], free_share: Float64Array) -> NDArray[np.uint8]:
        """What particles are, by the number of fluid particles around them (their section 3.3).

        Where a wall or body takes a part of the surroundings, the rest stands for the whole: a bubble at the bottom of
        the tank is no foam.
        """
        surrounding = neighbors / free_share
        kind = np.full(len(neighbors), WhitewaterKind.FOAM, np.uint8)
        kind[surrounding < self._parameters.spray_neighbors] = WhitewaterKind.SPRAY
        kind[surrounding > self._parameters.bubble_neighbors] = WhitewaterKind.BUBBLE
        return kind

    def _advect(
        self,
        position: Float64Array,
        velocity: Float64Array,
        flow: Float64Array,
        drag: Float64Array,
        kind_before: NDArray[np.uint8],
        kind: NDArray[np.uint8],
        dt: float,
    ) -> tuple[Float64Array, Float64Array]:
        """Spray flies, foam goes with the fluid, bubbles rise; each exactly where the fluid's velocity is constant.

        Spray: dv/dt = g - k v, the rate k of its drag taken at the beginning (`drag_rate`) and v at the end, so that no
        step is too long; exact in a vacuum.
        Foam: x += dt (v + v~)/2 with v the fluid's velocity where the particle came from, so it turns with a vortex
        instead of spiralling out (Heun's method; their eq. 11 is explicit Euler).
        Bubbles: dv/dt = -k_b g + (v~ - v)/tau (their eq. 12 with k_d = dt/tau), solved exactly for constant v~.
        """
        moved, changed = position + dt * velocity, velocity.copy()
        spray, foam, bubble = (kind == each for each in WhitewaterKind)
        changed[spray] = (velocity[spray] + dt * self._gravity) / (1.0 + dt * drag[spray, None])
        moved[spray] = position[spray] + 0.5 * dt * (velocity[spray] + changed[spray])

        was_carried = kind_before[foam] == WhitewaterKind.FOAM
        came_with = np.where(was_carried[:, None], velocity[foam], flow[foam])
        moved[foam] = position[foam] + 0.5 * dt * (came_with + flow[foam])
        changed[foam] = flow[foam]

        buoyancy = -self._parameters.bubble_buoyancy * self._gravity
        acceleration = float(np.linalg.norm(buoyancy))
        # Without buoyancy nothing tells how strong the drag is: the bubble goes with the fluid.
        tau = self._parameters.bubble_rise_speed / acceleration if acceleration > 0.0 else 0.0
        decay = math.exp(-dt / tau) if tau > 0.0 else 0.0
        terminal = flow[bubble] + tau * buoyancy
        lag = velocity[bubble] - terminal
        moved[bubble] = position[bubble] + dt * terminal + tau * (1.0 - decay) * lag
        changed[bubble] = terminal + decay * lag
        return moved, changed

    def _settled(self, born: WhitewaterCloud, field: FluidField, obstacles: Obstacles, share: float) -> WhitewaterCloud:
        """New particles outside of solids, as what they are."""
        if len(born) == 0:
            return born
        position, velocity, _, stays = obstacles.collide(
            born.position.astype(np.float64), born.velocity.astype(np.float64), share
        )
        flow, neighbors = field.sample(position.astype(np.float32))
        kind = self._classify(neighbors, obstacles.free_share(position, field.support_radius, share))
        foam = kind == WhitewaterKind.FOAM
        velocity[foam] = flow[foam]
        placed = replace(born, position=position.astype(np.float32), velocity=velocity.astype(np.float32), kind=kind)
        return placed.kept(stays)
