"""Two-way coupling of smoke and the cloths that hang in it."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import taichi as ti

from sim.cloth.air import WIND
from sim.cloth.bundles import Triples
from sim.core.arrays import Floats, Integers, LongIntegers, Vectors
from sim.core.bundles import bundle, func
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.solver import Coupling
from sim.smoke.arrays import Faces, new_floats
from sim.smoke.interpolation import corner, weight
from sim.smoke.lanes import Grid, cell_counts
from sim.smoke.obstacles import time_of_travel

if TYPE_CHECKING:
    from sim.cloth.solver import ClothSolver
    from sim.smoke.solver import SmokeSolver

QUANTUM = 2.0**-40  # unit of the sums over triangles [m/s, m²/kg]: far below what float32 tells; sums reach 8e6
MOST_CELLS_PASSED = 1.0  # of air past a cloth in a step of the smoke: what it takes from them is taken where they are


@bundle
class Sums(NamedTuple):
    """Sums over the triangles around each face, flat, in units of `QUANTUM`."""

    x: LongIntegers
    y: LongIntegers
    z: LongIntegers


@bundle
class Box(NamedTuple):
    """The smoke around the triangles."""

    number: ti.i32  # of the smoke
    origin: ti.math.vec3  # [m]
    cell_size: ti.f32  # [m]
    cells: Grid
    sums: Sums


@bundle
class Hanging(NamedTuple):
    """The triangles of all cloths, (k,) each, and what they are told of the air; see `ClothAir`."""

    triangles: Triples
    density: Floats
    source: Integers
    velocity: Vectors
    inverse_mass: Floats
    impulse: Vectors
    place: Vectors  # of the middle in the smoke's box [cells]


class SmokeClothCoupling(Coupling):
    """Moving smoke drags cloth, and cloth slows the smoke.

    A coupled step of the smoke: cloth takes its own, shorter steps in the air as the smoke left it, and sums the
    impulses of the air on each triangle; then the smoke is carried along, and the faces of cells around where each
    triangle was take the opposite impulse, before the projection. A triangle asks for the air and answers to it at the
    same place and with the same trilinear weights. Momentum is kept to rounding, but for what falls on closed faces:
    walls and bodies take that.

    Air in a cell weighs little, and a strong drag would throw it far beyond the cloth's velocity. `ClothAir` bounds the
    impulse by the mass of air within reach, with the area of all triangles that share it:

        1 / m_t = sum_f w_tf sum_s w_sf A_s / (rho h³)   (the largest of the three axes),

    a row sum of the matrix by which impulses per area change what triangles see, so that the bound of each triangle
    alone is enough for all together: cloth and air do not gain energy from each other. That the smoke is carried along
    in between is a splitting error of first order in time.

    Cloth is porous here: no obstacle of the projection, it holds air back by its drag alone, and smoke passes it. Its
    drag coefficient applies to the air at the sheet, which the sheet has slowed already. The air's density is that of
    the cloth's parameters; outside of the smoke's box air is the cloth's wind, and inside the wind does not blow.

    """

    is_loose = True

    def __init__(self, cloth: "ClothSolver", smoke: "SmokeSolver", *, number: int = 0) -> None:
        """Couple the two; the smoke's number is its own among those of these cloths, whose boxes do not overlap."""
        self.bodies = (cloth.name, smoke.name)
        self._cloth, self._smoke, self._number = cloth, smoke, number
        grid, triangles = smoke.grid, cloth.state.triangle_count
        sums = Sums(*(ti.ndarray(ti.i64, grid.size) for _ in range(3)))
        self._box = Box(number, ti.math.vec3(grid.origin), grid.cell_size, smoke.obstacles.box, sums)
        self._place = ti.Vector.ndarray(3, ti.f32, triangles)
        self._fastest = new_floats(2)
        self._fastest_past = 0.0
        self._reaches_cloth = False
        smoke.air_forces.append(self)
        cloth.air.is_shared = True
        self.follow(0.0)

    @property
    def _hanging(self) -> Hanging:
        air = self._cloth.air
        told = air.density, air.source, air.velocity, air.inverse_mass, air.impulse
        return Hanging(self._cloth.state.triangles, *told, self._place)

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Collect the impulses that the air of the cells gave, for `accelerate`."""
        if self._reaches_cloth:
            _collect_impulses(self._box, self._hanging)

    def follow(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Tell every triangle of the air around it."""
        state, air = self._cloth.state, self._cloth.air
        _find_triangles(self._box, self._hanging, state.position, air.wind)
        _ask_air(self._box, self._hanging, self._smoke.state.velocity, state.velocity, air.share, self._fastest)
        fastest, found = (float(value) for value in copied(self._fastest))
        self._fastest_past, self._reaches_cloth = fastest, found > 0.0

    def resume(self) -> None:
        """Tell the restored cloth of the restored air."""
        self.follow(0.0)

    def stable_dt(self) -> float:
        """Step [s] in which the air passes a cloth that falls by `MOST_CELLS_PASSED` cells."""
        speed, distance = self._fastest_past, MOST_CELLS_PASSED * self._smoke.grid.cell_size
        fall = float(np.linalg.norm(self._cloth.gravity))
        return time_of_travel(distance, speed, fall) if self._reaches_cloth else math.inf

    def accelerate(self, dt: float) -> None:  # noqa: ARG002  (impulses are in place of forces)
        """Give the air what the last `exchange` collected."""
        if self._reaches_cloth:
            _push_air(self._box.sums, self._smoke.air.openness, self._smoke.state.velocity)


@func
def _spread(cells: Grid, sums: LongIntegers, axis: ti.template(), place, value: ti.f32):
    """Add a value to the faces around a place; integers, so that the order does not matter."""
    at, offset = corner(cells, place, axis)
    for n in ti.static(range(8)):
        part, step = weight(cells, offset, n)
        ti.atomic_add(sums[at + step], ti.round(part * value / QUANTUM, ti.i64))


@func
def _clear(sums: Sums):
    for at in range(sums.x.shape[0]):
        for values in ti.static((sums.x, sums.y, sums.z)):
            values[at] = ti.cast(0, ti.i64)


@kernel
def _find_triangles(box: Box, cloth: Hanging, position: Vectors, wind: Vectors):
    """Which triangles are in the box, where, and how much of them shares the air of each face, A / (rho h³)."""
    _clear(box.sums)
    for t in range(cloth.triangles.shape[0]):
        corners = cloth.triangles[t]
        x_a, x_b, x_c = position[corners[0]], position[corners[1]], position[corners[2]]
        middle = ((x_a + x_b + x_c) / 3.0 - box.origin) / box.cell_size
        end = ti.cast(cell_counts(box.cells), ti.f32)
        if (middle >= 0.0).all() and (middle <= end).all() and cloth.density[t] > 0.0:
            cloth.place[t] = middle
            if cloth.source[t] != box.number:
                cloth.source[t] = box.number
                cloth.impulse[t] = ti.math.vec3(0.0)
            share = 0.5 * (x_b - x_a).cross(x_c - x_a).norm() / (cloth.density[t] * box.cell_size**3)
            for axis, sums in ti.static(enumerate((box.sums.x, box.sums.y, box.sums.z))):
                _spread(box.cells, sums, axis, middle, share)
        elif cloth.source[t] == box.number:
            cloth.source[t] = WIND
            cloth.velocity[t] = wind[t]
            cloth.inverse_mass[t] = 0.0


@kernel
def _ask_air(box: Box, cloth: Hanging, faces: Faces, node_velocity: Vectors, node_share: Floats, fastest: Floats):
    """Velocity of the air at each triangle in the box, and how little of it there is; the largest past a cloth."""
    for k in range(2):
        fastest[k] = 0.0
    for t in range(cloth.triangles.shape[0]):
        if cloth.source[t] == box.number:
            air = ti.math.vec3(0.0)
            reach = ti.math.vec3(0.0)
            for axis, face, sums in ti.static(
                ((0, faces.x, box.sums.x), (1, faces.y, box.sums.y), (2, faces.z, box.sums.z))
            ):
                at, offset = corner(box.cells, cloth.place[t], axis)
                for n in ti.static(range(8)):
                    part, step = weight(box.cells, offset, n)
                    air[axis] += part * face[at + step]
                    reach[axis] += part * (ti.cast(sums[at + step], ti.f32) * QUANTUM)
            cloth.velocity[t] = air
            cloth.inverse_mass[t] = reach.max()
            past = air
            for k in ti.static(range(3)):
                past -= node_share[cloth.triangles[t][k]] * node_velocity[cloth.triangles[t][k]]
            ti.atomic_max(fastest[0], past.norm())
            ti.atomic_max(fastest[1], 1.0)


@kernel
def _collect_impulses(box: Box, cloth: Hanging):
    """Changes of the velocity of each face's air [m/s], -sum_t w_tf J_t / (rho h³); impulses start anew."""
    _clear(box.sums)
    for t in range(cloth.triangles.shape[0]):
        if cloth.source[t] == box.number and cloth.density[t] > 0.0:  # the air may have been taken away since, live
            change = -cloth.impulse[t] / (cloth.density[t] * box.cell_size**3)
            for axis, sums in ti.static(enumerate((box.sums.x, box.sums.y, box.sums.z))):
                _spread(box.cells, sums, axis, cloth.place[t], change[axis])
            cloth.impulse[t] = ti.math.vec3(0.0)


@kernel
def _push_air(sums: Sums, openness: Faces, velocity: Faces):
    for at in range(sums.x.shape[0]):
        for face, is_open, change in ti.static(
            (
                (velocity.x, openness.x, sums.x),
                (velocity.y, openness.y, sums.y),
                (velocity.z, openness.z, sums.z),
            )
        ):
            if is_open[at] > 0.0:
                face[at] += ti.cast(change[at], ti.f32) * QUANTUM
