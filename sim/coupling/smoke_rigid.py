"""Rigid bodies that move through smoke."""

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.arrays import Floats, Integers, Matrices, Vectors
from sim.cloth.rigid_contact import CountTriples, distance_at
from sim.cloth.rigid_contact_bodies import CollisionBodies

if TYPE_CHECKING:
    from sim.rigid.solver import RigidSolver
    from sim.smoke.solver import SmokeSolver


@ti.data_oriented
class SmokeRigidCoupling:
    """Bodies are obstacles for the air, and push it with the velocity of their surface, v + omega x r.

    One way: bodies do not feel the air. Its density is a thousandth of theirs, and a smoke of constant density has no
    pressure in pascals to give. The smoke takes its own steps; before each, bodies go ahead to its end, and the cells
    whose centres are inside of them there are marked.

    Attributes:
        bodies: names of the rigid solver and of the smoke.
    """

    is_loose = True

    def __init__(self, rigid: "RigidSolver", smoke: "SmokeSolver") -> None:
        """Couple the two; `exchange` marks where the bodies start, for the smoke to commit.

        Raises:
            ValueError: a body is thinner than a cell.
        """
        self.bodies = (rigid.name, smoke.name)
        self._rigid, self._smoke, self._obstacles = rigid, smoke, smoke.obstacles
        for name, geometry in zip(rigid.bodies.names, rigid.solids, strict=True):
            if geometry.shortest_edge < smoke.grid.cell_size:
                raise ValueError(
                    f'smoke "{smoke.name}": "{name}", a body {geometry.shortest_edge:.3g} m thin, would fall between '
                    f"its cells of {smoke.grid.cell_size:g} m; use a smaller cell_size or a thicker body"
                )
        self._shapes = CollisionBodies(rigid.solids, friction=[0.0] * len(rigid.solids))
        self._velocity, self._spin = (ti.Vector.ndarray(3, ti.f32, len(rigid.solids)) for _ in range(2))
        self.follow(0.0)

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Mark the cells that the bodies fill at the end of a step of the smoke of dt [s]."""
        bodies, shapes = self._rigid.bodies, self._shapes
        shapes.place(self._rigid.poses(), np.zeros(len(bodies)), np.zeros((len(bodies), 3, 3)))
        self._velocity.from_numpy(bodies.velocity.astype(np.float32))
        self._spin.from_numpy(bodies.angular_velocity.astype(np.float32))
        grid, turned = self._smoke.grid, bodies.rotation()
        for number, geometry in enumerate(self._rigid.solids):
            half, middle = 0.5 * np.ptp(geometry.bounds, axis=0), geometry.bounds.mean(axis=0)
            centre, reach = bodies.position[number] + turned[number] @ middle, np.abs(turned[number]) @ half
            # Cells from 1 whose centres lie in the body's box.
            first = np.ceil((centre - reach - grid.origin) / grid.cell_size + 0.5)
            last = np.floor((centre + reach - grid.origin) / grid.cell_size + 0.5)
            low = [int(n) for n in np.clip(first, 1, np.add(grid.cells, 1))]
            high = [int(n) for n in np.clip(last, 0, grid.cells)]
            if all(begin <= end for begin, end in zip(low, high, strict=True)):
                self._mark(
                    number,
                    ti.Vector(low),
                    ti.Vector(high),
                    shapes.kind,
                    shapes.size,
                    shapes.centre_of_mass,
                    shapes.grid_values,
                    shapes.grid_first,
                    shapes.grid_origin,
                    shapes.grid_spacing,
                    shapes.grid_shape,
                    shapes.position,
                    shapes.rotation,
                    self._velocity,
                    self._spin,
                )

    def follow(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Tell the smoke how fast the bodies are."""
        self._obstacles.expect(self._rigid.name, self._rigid.max_surface_speed())

    def resume(self) -> None:
        """Tell the restored smoke how fast the restored bodies are; where they are it has saved itself."""
        self.follow(0.0)

    @ti.kernel
    def _mark(
        self, body: ti.i32, low: ti.math.ivec3, high: ti.math.ivec3, kind: Integers, size: Vectors,
        centre_of_mass: Vectors, grid_values: Floats, grid_first: Integers, grid_origin: Vectors,
        grid_spacing: Floats, grid_shape: CountTriples, position: Vectors, rotation: Matrices,
        velocity: Vectors, spin: Vectors,
    ):  # fmt: skip
        """Mark the cells from `low` to `high` whose centres lie in a body."""
        for i, j in ti.ndrange((low[0], high[0] + 1), (low[1], high[1] + 1)):
            for k in range(low[2], high[2] + 1):
                arm = self._obstacles.centre(i, j, k) - position[body]
                place = rotation[body].transpose() @ arm + centre_of_mass[body]
                distance = distance_at(
                    place, body, kind, size, grid_values, grid_first, grid_origin, grid_spacing, grid_shape
                )
                if distance < 0.0:
                    self._obstacles.mark(i, j, k, velocity[body] + spin[body].cross(arm))
