"""Rigid bodies that move through smoke."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.launch import kernel
from sim.core.motion.paths import ArcLength, Path
from sim.core.solver import Coupling
from sim.rigid.surroundings import AirBox
from sim.shapes.moving_shapes import Bodies, MovingShapes, distance_of, velocity_at
from sim.smoke.free_bodies import FreeBodies
from sim.smoke.lanes import Grid, row_start
from sim.smoke.obstacles import NOBODY, Marks, mark, time_of_travel

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.rigid.solver import RigidSolver
    from sim.smoke.solver import SmokeSolver

MARGIN = (
    1.5  # beyond a body's box in which corners are marked: those of all cells that it cuts, whatever rounding [cells]
)


class SmokeRigidCoupling(Coupling):
    """Bodies are obstacles for the air, and push it with the velocity of their surface, v + omega x r + u; u where it
    deforms. The pressure of the air pushes dynamic ones.

    A coupled step: the smoke takes its own steps, and before each bodies go ahead to its end, by their weight, contacts
    and the force of the air in the step before. There the corners of cells about them are marked with the velocities
    that they would have without that force. The projection finds the pressure, and what bodies yield to it
    (`free_bodies`); they get its impulses in place of what was foreseen (`Surroundings`). Momentum that the projection
    takes from the air bodies get, to rounding; velocity alone is carried along the flow without keeping it.

    The pressure is that of the air's motion and of what is hot or heavy in it. That of air at rest is not in it:
    `Surroundings` have the weight of what is displaced. Nothing rubs. In a step the air knows how bodies yield as far
    as `RigidSolver.mobility` does; bodies that rest asleep, and that joints hold to what stands, do not. The level of
    pressure in a closed room is arbitrary: it matters only where bodies touch, which shuts the air out there.

    A body feels the first smoke in whose box its centre of mass is, and is in the way of all. Beyond a window, where
    bodies may sleep, winds act on them themselves; what they wake is in the window from the next frame on.

    Steps are cut so that no body gets farther than a cell within the box: along its path if it is kinematic, with its
    velocity and gravity if it is dynamic; one outside has the way to the box to go first. What collisions, water, air
    and cloth add to a dynamic body in a step of the smoke is not foreseen: it may leap over cells in that one.

    """

    is_loose = True

    def __init__(self, rigid: "RigidSolver", smoke: "SmokeSolver", *, domain: "DomainParameters") -> None:
        """Couple the two; `exchange` marks where the bodies start, for the smoke to commit.

        Bodies should be no thinner than a cell (`smoke_reach.too_thin_bodies`).
        """
        self.bodies = (rigid.name, smoke.name)
        self._rigid, self._smoke = rigid, smoke
        self._shapes = MovingShapes(rigid.solids)
        self._ways: dict[int, tuple[Path, ArcLength]] = {}
        smoke.obstacles.movers.append(self)
        self._number = len(rigid.surroundings.boxes)
        self.pushes_first = smoke.free_bodies is not None
        if self.pushes_first:
            low, high = (np.array(corner) for corner in smoke.parameters.limits(domain))
            box = AirBox(low, high, smoke.parameters.air_density, lambda: (smoke.grid.origin, smoke.grid.upper))
            rigid.surroundings.boxes.append(box)

    def stable_dt(self) -> float:
        """Largest step [s] in which no body gets farther than a cell in the box, as far as is foreseen."""
        rigid, bodies, grid = self._rigid, self._rigid.bodies, self._smoke.grid
        place, radius = bodies.position, np.array([geometry.radius for geometry in rigid.solids])
        outside = np.maximum(np.maximum(grid.origin - place, place - grid.upper), 0.0)
        distance = np.maximum(np.linalg.norm(outside, axis=1) - radius, 0.0) + grid.cell_size
        speed = np.linalg.norm(bodies.velocity, axis=1) + radius * np.linalg.norm(bodies.angular_velocity, axis=1)
        gravity = float(np.linalg.norm(rigid.gravity))
        times = [
            time_of_travel(float(distance[number]), float(speed[number]), gravity)
            for number in np.flatnonzero(bodies.is_free)
        ]
        times += [
            self._way_of(number, path).time_of_travel(float(distance[number]), rigid.time_s)
            for number, path in rigid.paths.items()
        ]
        return min(times, default=math.inf)

    def _way_of(self, number: int, path: Path) -> ArcLength:
        """Of a kinematic body on its path, which is another one once the body has been led live."""
        known = self._ways.get(number)
        if known is None or known[0] is not path:
            geometry = self._rigid.solids[number]
            reach = float(np.linalg.norm(geometry.centre_of_mass)) + geometry.radius
            way, deformation = path.arc_length(reach), geometry.deformation
            if deformation is not None:
                # As if it deformed at its fastest until it ends.
                way = replace(way, lengths=way.lengths + deformation.largest_speed * (way.times - way.times[0]))
            known = self._ways[number] = (path, way)
        return known[1]

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Mark the corners about the bodies at the end of a step of the smoke of dt [s]."""
        rigid, grid, obstacles = self._rigid, self._smoke.grid, self._smoke.obstacles
        turned = rigid.bodies.rotation()
        self._shapes.put(rigid.bodies.position, turned, *rigid.surroundings.velocities(), rigid.time_s)
        corners, owners = self._corners(turned), np.full(len(turned), NOBODY)
        if self._smoke.free_bodies is not None:
            owners = self._place(self._smoke.free_bodies, corners)
        for number in np.flatnonzero((corners[:, 0] <= corners[:, 1]).all(axis=1)).tolist():
            low, high = (ti.math.ivec3(corner) for corner in corners[number].tolist())
            window = low, high, ti.math.vec3(grid.origin), grid.cell_size
            _mark_body(number, int(owners[number]), *window, obstacles.box, obstacles.marks, self._shapes.bodies)

    def reach(self, duration_s: float) -> list[NDArray[np.float64]]:
        """Boxes around the bodies that the air may push, and are awake, and their way by their velocities [m]."""
        bodies = self._rigid.bodies
        if self._smoke.free_bodies is None:
            return []
        moves = bodies.is_free & ~bodies.is_asleep & (self._rigid.surroundings.where() == self._number)
        centre, reach = self._boxes(bodies.rotation())
        way = duration_s * bodies.velocity
        low, high = centre - reach + np.minimum(way, 0.0), centre + reach + np.maximum(way, 0.0)
        boxes = np.stack([low, high], axis=1)
        return list(boxes[moves & np.isfinite(boxes).all(axis=(1, 2))])

    def follow(self, dt: float) -> None:
        """Hand the impulses of the air in a step of dt [s] to the bodies."""
        if self._smoke.free_bodies is not None:
            impulses = self._smoke.free_bodies.impulses()
            self._rigid.surroundings.settle(self._number, impulses, self._mobility(), dt)

    def _corners(self, turned: NDArray[np.float64]) -> NDArray[np.int64]:
        """Lowest and highest corner, counted from 1, in each body's box and `MARGIN` beyond, (n, 2, 3).

        None, one above the other, of a body whose pose is not finite: the world's look at the state names it.
        """
        grid = self._smoke.grid
        centre, reach = self._boxes(turned)
        first = np.ceil((centre - reach - grid.origin) / grid.cell_size + 1.0 - MARGIN)
        last = np.floor((centre + reach - grid.origin) / grid.cell_size + 1.0 + MARGIN)
        is_bad = ~np.isfinite(first + last).all(axis=1)
        first[is_bad], last[is_bad] = np.inf, -np.inf
        low, high = np.clip(first, 1, np.add(grid.cells, 2)), np.clip(last, 0, np.add(grid.cells, 1))
        return np.stack([low, high], axis=1).astype(np.int64)

    def _boxes(self, turned: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Centres and half edges of the boxes around the bodies [m], (n, 3) each."""
        bounds = np.array([geometry.bounds for geometry in self._rigid.solids])
        half, middle = 0.5 * np.ptp(bounds, axis=1), bounds.mean(axis=1)
        centre = self._rigid.bodies.position + np.einsum("nij,nj->ni", turned, middle)
        return centre, np.einsum("nij,nj->ni", np.abs(turned), half)

    def _mobility(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How easily what is awake, and in this air, yields to it."""
        inverse_mass, inverse_inertia = self._rigid.mobility()
        still = self._rigid.bodies.is_asleep | (self._rigid.surroundings.where() != self._number)
        inverse_mass[still], inverse_inertia[still] = 0.0, 0.0
        return inverse_mass, inverse_inertia

    def _place(self, free: FreeBodies, corners: NDArray[np.int64]) -> NDArray[np.int64]:
        """Tell the air of the bodies that it pushes; returns the owner of each body's corners, (n,)."""
        rigid = self._rigid
        glue = rigid.glue
        leader = np.arange(len(corners)) if glue is None else glue.leader
        centre = (rigid.bodies if glue is None else glue.movers).position
        is_own = rigid.bodies.is_dynamic & (rigid.surroundings.where() == self._number)
        around = np.stack([np.full((len(corners), 3), 2**31 - 1), np.full((len(corners), 3), -1)], axis=1)
        np.minimum.at(around[:, 0], leader[is_own], corners[is_own, 0])
        np.maximum.at(around[:, 1], leader[is_own], corners[is_own, 1])
        obstacles, density = self._smoke.obstacles, self._smoke.parameters.air_density
        free.place(obstacles, around, centre, *self._mobility(), density)
        owners: NDArray[np.int64] = np.where(is_own, leader, NOBODY)
        return owners


@kernel
def _mark_body(
    body: ti.i32,
    owner: ti.i32,
    low: ti.math.ivec3,
    high: ti.math.ivec3,
    origin: ti.math.vec3,
    cell_size: ti.f32,
    box: Grid,
    marks: Marks,
    bodies: Bodies,
):
    """Mark the corners from `low` to `high`."""
    for i, j in ti.ndrange((low[0], high[0] + 1), (low[1], high[1] + 1)):
        for k in range(low[2], high[2] + 1):
            corner = origin + cell_size * (ti.Vector([float(i), float(j), float(k)]) - 1.0)
            distance = distance_of(corner, body, bodies) / cell_size
            mark(marks, row_start(box, i, j) + k, distance, velocity_at(corner, body, bodies), owner)
