"""Soft matter: all bodies of sand, snow, jelly or clay of a scene, on one sparse grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import on_device
from sim.core.box import box_of
from sim.core.domain import DomainParameters
from sim.core.host_access import add, copied, viewed
from sim.core.parameters import Vector3
from sim.core.reductions import LaneReduction
from sim.core.snapshots import Snapshot
from sim.core.solver import Arrays, Diagnostics, Remedies
from sim.forces.field import ForceField
from sim.shapes.filled_volume import Surroundings, pack
from sim.shapes.placement import build_solid
from sim.soft.blocks import NODES, BlockGrid, Blocks, sorted_by_cell
from sim.soft.contact import BodyContacts, stop_at_walls
from sim.soft.laws import APART, DENSE, Laws
from sim.soft.materials import Law
from sim.soft.packing import find_room
from sim.soft.parameters import LIVE_KEYS, SoftParameters, shared_conflicts
from sim.soft.pouring import Poured, Pouring, has_come, waiting_rows
from sim.soft.transfers import (
    COUNTS,
    MAXIMA,
    PARTS,
    SHARES,
    SYMMETRIC,
    Load,
    Nodes,
    Particles,
    Parting,
    grid_to_particles,
    measure,
    particles_to_grid,
    push_particles,
)

if TYPE_CHECKING:
    from sim.shapes.solid import Solid

SOLVER_NAME = "soft"

MOTION_NUMBER = 0.3  # cells that a particle crosses in it

STATE = ("position", "velocity", "affine", "strain", "stress", "history", "cohesion", "body")
"""Arrays that a checkpoint has."""

TINY_SPEED = 1.0e-12  # of what does not move at all [m/s]

MOST_SHARES = 2**31 - 1  # numbers that an array of a kernel can have

RUNAWAY_SPEED = 1.0e4  # no soft matter of a film moves at thirty times the speed of sound [m/s]


class SoftSolver:
    """All soft matter of a scene, which meets itself, walls and rigid bodies on the nodes of one grid.

    One step: masses and momenta of particles go to the nodes, with the impulses of their stresses; nodes are
    accelerated, and collide with bodies and walls; velocities go back to the particles, which move, are strained, and
    yield (`sim.soft.transfers`). Momentum and angular momentum are kept but for rounding (Jiang et al. 2015).

    Attributes:
        parameters: the bodies, in the order of the job.
        gravity: [m/s²]; may be changed between frames.
        contacts: rigid bodies that soft matter meets; None where there are none.
        particles: for kernels.
        load: what touches the particles in the next step; none before `let_touch`.
        parting: the nodes that sheets hide from the particles; none before `let_part`.
        met_speed: of the fastest sheet [m/s].
        passed: particles that went through sheets in this frame, as these or walls pressed them.
        box: the domain, for kernels.
        masses: of a particle of each body [kg], (bodies,), on the device.
        spacing, volume: of particles at rest [m, m³].
        poured: what emitters let in.
        owner: the body of each particle, whether it is there, has left or is to come, (n,), on the host.
        mass: of all particles that there ever are [kg].

    Raises:
        ShapeError: a shape cannot be built.
        ValueError: bodies that cannot share a grid, a block without a particle, a domain that is too large.
    """

    def __init__(
        self,
        parameters: Sequence[SoftParameters],
        *,
        domain: DomainParameters,
        gravity: Vector3,
        solids: Sequence[Solid] = (),
        poured: Poured | None = None,
        forces: ForceField | None = None,
    ) -> None:
        self.name, self.parameters, self.gravity = SOLVER_NAME, tuple(parameters), gravity
        if conflicts := shared_conflicts(self.parameters):
            number, key, message = conflicts[0]
            raise ValueError(f'soft "{self.parameters[number].name}": {key} {message}')
        position, velocity, body, dye, volume = _filled(self.parameters, domain, solids)
        self.poured = poured or Poured.together([])
        self.owner = np.concatenate([body, self.poured.body])
        self._dye = np.concatenate([dye, self.poured.dye])
        self._pouring = Pouring(self.poured, len(position)) if len(self.poured.body) else None
        rows = zip((position, velocity, body), waiting_rows(self.poured), strict=True)
        position, velocity, body = (np.concatenate(each) for each in rows)
        n = len(position)
        density = np.array([each.value("density") for each in self.parameters])
        particle_mass = density * volume
        self.mass = float(particle_mass[self.owner].sum())
        rows_of = [ti.ndarray(ti.f32, components * n) for components in (9, len(SYMMETRIC), len(SYMMETRIC))]
        is_sand = np.array([each.row.law == Law.SAND for each in self.parameters])
        self._has_sand = bool(is_sand.any())
        history = on_device(np.where((body < 0) & is_sand[self.owner], np.float32(APART), np.float32(0.0)))
        has_snow = any(each.row.law == Law.SNOW for each in self.parameters)
        cohesion = on_device(np.ones(n if has_snow else 1, np.float32))
        rows = on_device(position), on_device(velocity), *rows_of, history, cohesion, on_device(body)
        self.particles = Particles(*rows, n)
        self.spacing = self.parameters[0].spacing
        self.masses, self.volume = on_device(particle_mass), volume
        self._load_particles(0)
        self._find_hidden: Callable[[Blocks], None] | None = None
        self._part_particles(0)
        self.met_speed, self.passed = 0.0, 0
        self._laws = laws_of(self.parameters)
        self._grid = BlockGrid(domain, self.parameters[0].cell_size, n)
        self._make_nodes()
        self.box = box_of(domain)
        self._forces = (forces or ForceField(())).on([(each.name,) for each in self.parameters])
        self._reduction = LaneReduction(maxima=MAXIMA, sums=COUNTS)
        self.contacts: BodyContacts | None = None
        self._time_s = 0.0
        self._measure()

    def let_touch(self) -> None:
        """Make room for what touches particles, which whoever couples them gives before each step."""
        self._load_particles(self.particles.count)

    def _load_particles(self, count: int) -> None:
        arrays = ti.ndarray(ti.f32, max(count, 1)), ti.Vector.ndarray(3, ti.f32, max(count, 1))
        self.load = Load(*arrays, there=count > 0)

    def let_part(self, find_hidden: Callable[[Blocks], None]) -> None:
        """Have `find_hidden` find what sheets part in each substep, once particles are sorted into the stored blocks.

        Whoever couples the sheets ends each substep by `end_substep`, when it knows how they move.
        """
        self._find_hidden = find_hidden
        self._part_particles(self.particles.count)

    def _part_particles(self, count: int) -> None:
        arrays = ti.ndarray(ti.i32, max(count, 1)), ti.Vector.ndarray(3, ti.f32, max(count, 1))
        self.parting = Parting(*arrays, there=count > 0)

    def placed_by_others(self) -> None:
        """Whoever couples soft matter has put particles elsewhere."""
        self._grid.moved(math.inf)

    def _make_nodes(self) -> None:
        room = self._grid.blocks.room * NODES
        if PARTS * SHARES * room > MOST_SHARES:
            raise ValueError(
                f"soft matter fills {room:.3g} cells, more than {MOST_SHARES // (PARTS * SHARES):.3g}; use a larger "
                "cell_size"
            )
        masses, rooms = ti.ndarray(ti.f32, room), ti.ndarray(ti.f32, room if self._has_sand else 1)
        self._nodes = Nodes(masses, ti.Vector.ndarray(3, ti.f32, room), rooms)
        self._shares = ti.ndarray(ti.f32, PARTS * SHARES * room)

    def _measure(self) -> None:
        """Note how fast particles are, how hard, and whether all are finite."""
        results = measure(self.particles, self._laws, self._reduction.over(self.particles.count))
        squared_speed, self._hardened, self._bad, self._apart = self._reduction.unpack(results).tolist()
        self._speed = math.sqrt(squared_speed)

    def change(self, name: str, **changes: object) -> None:
        """Change what a body is made of between frames, by the keys of a job.

        Raises:
            ValueError: a key that cannot change, or a value that it cannot have; nothing has changed then.
        """
        if fixed := set(changes) - set(LIVE_KEYS):
            raise ValueError(f"{min(fixed)} of soft matter cannot change while it is simulated; build it anew")
        number = [each.name for each in self.parameters].index(name)
        changed = SoftParameters.model_validate({**self.parameters[number].model_dump(exclude_unset=True), **changes})
        self.parameters = (*self.parameters[:number], changed, *self.parameters[number + 1 :])
        self._laws = laws_of(self.parameters)
        self._measure()

    # --- the step ---------------------------------------------------------------------------------------------------

    def stable_dt(self) -> float:
        """Largest step [s] in which neither waves nor particles cross more than a part of a cell."""
        shared, fall = self.parameters[0], float(np.linalg.norm(self.gravity)) + self._forces.largest_acceleration
        by_waves = min(
            each.longest_step / (math.sqrt(self._hardened) if each.row.law == Law.SNOW else 1.0)
            for each in self.parameters
        )
        way = shared.cfl * MOTION_NUMBER * shared.cell_size
        poured = 0.0 if self._pouring is None else self._pouring.largest_speed
        speed = max(self._speed, self.met_speed, poured)
        return min(by_waves, way / max(speed, math.sqrt(way * fall), TINY_SPEED))

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        particles, grid = self.particles, self._grid
        if self._pouring is not None and self._pouring.let_in(particles, self._time_s):
            grid.moved(math.inf)
            if self._has_sand:
                self._measure()
        self._time_s += dt
        if self._forces.accelerates:
            push_particles(particles, self._forces.now, dt)
        if grid.sort(particles.position, particles.body):
            self._make_nodes()
        blocks, stored = grid.blocks, grid.count
        if self._find_hidden is not None:
            self._find_hidden(blocks)
        touching = self.masses, self.volume, self.load, self.parting
        particles_to_grid(
            blocks, stored, particles, *touching, self._shares, self._nodes, ti.math.vec3(self.gravity), dt
        )
        if self.contacts is not None:
            self.contacts.resolve(blocks, stored, self._nodes, dt)
        stop_at_walls(blocks, stored, self._nodes, self.box, self.parameters[0].friction)
        if self._apart > 0.0:
            self._find_room()
        if self._find_hidden is None:
            self.end_substep(dt)

    def _find_room(self) -> None:
        """Find what walls and bodies leave of the nodes."""
        blocks, stored, nodes = self._grid.blocks, self._grid.count, self._nodes
        find_room(blocks, stored, nodes.mass, nodes.room, self.box)
        if self.contacts is not None:
            self.contacts.take_room(blocks, stored, nodes)

    def end_substep(self, dt: float) -> None:
        """Take velocities back from the nodes, and move for dt [s]."""
        grid, given = self._grid, (self._laws, self._nodes, self.parting, self.box)
        grid_to_particles(grid.blocks, grid.count, self.particles, *given, dt)
        self._measure()
        grid.moved(dt * self._speed)

    def begin_frame(self, time_s: float) -> None:
        """Emitters go by the time of the frame; blocks are found anew, as after a restart."""
        self._time_s = time_s
        self._grid.moved(math.inf)
        self.passed = 0

    # --- what others ask --------------------------------------------------------------------------------------------

    def _rows(self, name: str) -> NDArray[np.bool_]:
        number = [each.name for each in self.parameters].index(name)
        rows: NDArray[np.bool_] = copied(self.particles.body) == number
        return rows

    def snapshots(self) -> dict[str, Snapshot]:
        """Particles of each body."""
        body, position, velocity = (
            copied(array) for array in (self.particles.body, self.particles.position, self.particles.velocity)
        )
        found = {}
        for number, each in enumerate(self.parameters):
            rows = np.flatnonzero(body == number)
            arrays = {"position": position[rows], "velocity": velocity[rows], "particle_id": rows.astype(np.int32)}
            if each.has_dye:
                arrays["dye"] = self._dye[rows]
            found[each.name] = Snapshot("soft", arrays, {"radius": 0.5 * each.spacing, "material": each.material})
        return found

    def view(self, body: str) -> dict[str, NDArray[np.generic]]:
        """Positions [m] and velocities [m/s] of a body's particles, (n, 3) each."""
        rows = self._rows(body)
        return {"position": viewed(self.particles.position)[rows], "velocity": viewed(self.particles.velocity)[rows]}

    def push(self, body: str, change: NDArray[np.floating]) -> None:
        """Change velocities of a body's particles by (n, 3) or (3,) [m/s]."""
        rows = np.flatnonzero(self._rows(body))
        add(self.particles.velocity, rows, np.broadcast_to(change, (len(rows), 3)))
        self._measure()

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """All arrays of the particles."""
        return {name: copied(getattr(self.particles, name)) for name in STATE}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when it does not fit."""
        for name in STATE:
            array = getattr(self.particles, name)
            expected = (*array.shape, *array.element_shape)
            if arrays[name].shape != expected:
                raise ValueError(f"{name} of the checkpoint has shape {arrays[name].shape}, not {expected}")
            array.from_numpy(np.ascontiguousarray(arrays[name]))
        self._grid.moved(math.inf)
        if self._pouring is not None:
            self._pouring.here = int(has_come(arrays["body"])[-self._pouring.count :].sum())
        self._measure()

    def diagnostics(self) -> Diagnostics:
        """Momentum, energies and sizes."""
        body = copied(self.particles.body)
        inside = body >= 0
        mass = copied(self.masses)[body[inside]].astype(np.float64)
        position, velocity = (
            copied(array)[inside].astype(np.float64) for array in (self.particles.position, self.particles.velocity)
        )
        momentum = mass @ velocity
        return {
            "particle_count": float(inside.sum()),
            "particles_left": float((body == -1).sum()),
            "particles_through_cloth": float(self.passed),
            "mass": float(mass.sum()),
            "max_speed": self._speed,
            "kinetic_energy": float(0.5 * mass @ (velocity**2).sum(axis=1)),
            "momentum_x": float(momentum[0]),
            "momentum_y": float(momentum[1]),
            "momentum_z": float(momentum[2]),
            "centre_of_mass_z": float(mass @ position[:, 2] / mass.sum()) if len(mass) else 0.0,
            "blocks": float(self._grid.count),
        }

    def remedies(self) -> Remedies:
        """What may help where it fails."""
        stiffest = max(self.parameters, key=lambda each: each.wave_speed)
        return Remedies(
            runaway=f"set soft.cfl below {self.parameters[0].cfl:g}",
            short_steps=f"lower soft.{stiffest.name}.young_modulus, whose waves run at {stiffest.wave_speed:.3g} m/s, "
            "or use a larger cell_size",
        )

    def first_bad_quantity(self) -> str | None:
        """The first non-finite or runaway quantity, in words."""
        if self._bad > 0.0:
            return f"{self._bad:.0f} particles have a position or velocity that is not finite"
        if self._speed > RUNAWAY_SPEED:
            return f"a particle moves at {self._speed:.3g} m/s"
        return None


def _filled(
    parameters: Sequence[SoftParameters], domain: DomainParameters, solids: Sequence[Solid]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32], NDArray[np.float32], float]:
    """Positions [m], velocities [m/s], bodies and dye [-] of particles in all blocks, and the volume of each [m³]."""
    spacing = parameters[0].spacing
    positions, velocities = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.float32)]
    bodies, dyes = [np.empty(0, np.int32)], [np.empty(0, np.float32)]
    filled: list[Solid] = []
    for index, soft in enumerate(parameters):
        for number, block in enumerate(soft.block):
            solid = build_solid(block)
            around = Surroundings.in_domain(domain, solids, filled)
            points = pack(solid, spacing, around, np.concatenate(positions))
            filled.append(solid)
            if not len(points):
                raise ValueError(
                    f'soft "{soft.name}" block[{number}] has no particle: it is outside the domain, inside solids, or '
                    "filled by the blocks before it"
                )
            positions.append(sorted_by_cell(points, domain, parameters[0].cell_size))
            velocities.append(np.broadcast_to(np.float32(block.velocity), points.shape))
            bodies.append(np.full(len(points), index, dtype=np.int32))
            dyes.append(np.full(len(points), block.dye, dtype=np.float32))
    rows = (np.concatenate(each) for each in (positions, velocities, bodies, dyes))
    return (*rows, spacing**3)


def laws_of(parameters: Sequence[SoftParameters]) -> Laws:
    """Materials for kernels."""
    rows = []
    for each in parameters:
        mu, lam = each.lame
        # Shear of tan(phi) p, |s| = sqrt(2) tan(phi) p, with p = (3 lambda + 2 mu)/3 of the strain of volume.
        slope = math.sqrt(2.0) / 3.0 * math.tan(math.radians(each.value("friction_angle_deg")))
        # A shear of the cohesion is on the cone where the strain of volume is 0.
        tip = math.sqrt(2.0) * each.value("cohesion") / ((3.0 * lam + 2.0 * mu) * slope) if slope > 0.0 else 0.0
        yielding = math.sqrt(2.0 / 3.0) * each.value("yield_stress") / (2.0 * mu)
        least, most = 1.0 - each.value("critical_compression"), 1.0 + each.value("critical_stretch")
        power = 1.0 / (each.value("flow_exponent") or 1.0)
        flowing = 2.0 ** (0.5 - 0.5 * power) * (each.value("viscosity") / mu) ** power
        dense, hardening = DENSE * each.value("density"), each.value("hardening")
        tensile = each.value("young_modulus") * each.value("critical_stretch")
        tearing = each.value("fracture_energy") / (tensile * each.cell_size) if tensile > 0.0 else 0.0
        rows.append((dense, mu, lam, slope, tip, yielding, flowing, power, least, most, hardening, tearing))
    law = np.array([int(each.row.law) for each in parameters], dtype=np.int32)
    return Laws(on_device(law), *(on_device(np.array(column)) for column in zip(*rows, strict=True)))
