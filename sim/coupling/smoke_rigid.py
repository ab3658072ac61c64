"""Rigid bodies that move through smoke."""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.core.launch import kernel
from sim.core.motion.paths import ArcLength, Path
from sim.core.solver import Coupling
from sim.shapes.moving_shapes import Bodies, MovingShapes, distance_of, velocity_at
from sim.smoke.lanes import Grid, row_start
from sim.smoke.obstacles import Marks, mark, time_of_travel

if TYPE_CHECKING:
    from sim.rigid.solver import RigidSolver
    from sim.smoke.solver import SmokeSolver

MARGIN = (
    1.5  # beyond a body's box in which corners are marked: those of all cells that it cuts, whatever rounding [cells]
)


class SmokeRigidCoupling(Coupling):
    """Bodies are obstacles for the air, and push it with the velocity of their surface, v + omega x r + u; u where it
    deforms.

    One way: bodies do not feel the air. Its density is a thousandth of theirs, and a smoke of constant density has no
    pressure in pascals to give. The smoke takes its own steps; before each, bodies go ahead to its end, and the corners
    of cells about them there are marked.

    Steps are cut so that no body gets farther than a cell within the box: along its path if it is kinematic, with its
    velocity and gravity if it is dynamic; one outside has the way to the box to go first. What collisions, water and
    cloth add to a dynamic body in a step of the smoke is not foreseen: it may leap over cells in that one.

    """

    is_loose = True

    def __init__(self, rigid: "RigidSolver", smoke: "SmokeSolver") -> None:
        """Couple the two; `exchange` marks where the bodies start, for the smoke to commit.

        Bodies should be no thinner than a cell (`smoke_reach.too_thin_bodies`).
        """
        self.bodies = (rigid.name, smoke.name)
        self._rigid, self._smoke = rigid, smoke
        self._shapes = MovingShapes(rigid.solids)
        self._ways: dict[int, tuple[Path, ArcLength]] = {}
        smoke.obstacles.movers.append(self)

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
        bodies, grid, obstacles = self._rigid.bodies, self._smoke.grid, self._smoke.obstacles
        turned = bodies.rotation()
        self._shapes.put(bodies.position, turned, bodies.velocity, bodies.angular_velocity, self._rigid.time_s)
        for number, geometry in enumerate(self._rigid.solids):
            half, middle = 0.5 * np.ptp(geometry.bounds, axis=0), geometry.bounds.mean(axis=0)
            centre, reach = bodies.position[number] + turned[number] @ middle, np.abs(turned[number]) @ half
            # Corners from 1 in the body's box and `MARGIN` beyond.
            first = np.ceil((centre - reach - grid.origin) / grid.cell_size + 1.0 - MARGIN)
            last = np.floor((centre + reach - grid.origin) / grid.cell_size + 1.0 + MARGIN)
            low = [int(n) for n in np.clip(first, 1, np.add(grid.cells, 2))]
            high = [int(n) for n in np.clip(last, 0, np.add(grid.cells, 1))]
            if all(begin <= end for begin, end in zip(low, high, strict=True)):
                window = ti.math.ivec3(low), ti.math.ivec3(high), ti.math.vec3(grid.origin), grid.cell_size
                _mark_body(number, *window, obstacles.box, obstacles.marks, self._shapes.bodies)


@kernel
def _mark_body(
    body: ti.i32,
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
            mark(marks, row_start(box, i, j) + k, distance, velocity_at(corner, body, bodies))
