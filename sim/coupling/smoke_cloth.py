"""Two-way coupling of smoke and the cloths that hang in it."""

import math
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.cloth.air import WIND, Triangles
from sim.core.arrays import Floats, Integers, Vectors
from sim.smoke.obstacles import time_of_travel

if TYPE_CHECKING:
    from sim.cloth.solver import ClothSolver
    from sim.smoke.solver import SmokeSolver

QUANTUM = 2.0**-40
"""Unit of the sums over triangles [m/s, m²/kg]: far below what float32 tells of any of them; sums reach 8e6."""

MOST_CELLS_PASSED = 1.0
"""Most cells of air that may pass a cloth in a step of the smoke: what it takes from them is taken where they are."""


@ti.data_oriented
class SmokeClothCoupling:
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

    Attributes:
        bodies: names of the cloth's solver and of the smoke.
    """

    is_loose = True

    def __init__(self, cloth: "ClothSolver", smoke: "SmokeSolver", *, number: int = 0) -> None:
        """Couple the two.

        Args:
            cloth: the cloths.
            smoke: in whose air they hang.
            number: of the smoke, its own among those that are coupled to these cloths; their boxes do not overlap.
        """
        self.bodies = (cloth.name, smoke.name)
        self._cloth, self._smoke, self._number = cloth, smoke, number
        grid = smoke.grid
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y, self._size = grid.padded[1] * grid.padded[2], grid.padded[2], grid.size
        self._u, self._v, self._w = smoke.u_face_x, smoke.v_face_y, smoke.w_face_z
        self._open_x, self._open_y, self._open_z = smoke.openness
        self._sums_x, self._sums_y, self._sums_z = (ti.field(ti.i64, shape=grid.size) for _ in range(3))
        self._place = ti.Vector.ndarray(3, ti.f32, cloth.state.triangle_count)
        self._fastest = ti.field(ti.f32, shape=2)
        self._fastest_past = 0.0
        self._reaches_cloth = False
        smoke.air_forces.append(self)
        cloth.air.is_shared = True
        self.follow(0.0)

    # --- the coupling -----------------------------------------------------------------------------------------------

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Collect the impulses that the air of the cells gave, for `accelerate`."""
        air = self._cloth.air
        if self._reaches_cloth:
            self._clear_sums()
            self._collect_impulses(self._place, air.source, air.density, air.impulse)

    def follow(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Tell every triangle of the air around it."""
        state, air = self._cloth.state, self._cloth.air
        self._clear_sums()
        self._find_triangles(
            state.position, state.triangles, air.density, air.wind, air.source, air.velocity, air.inverse_mass,
            air.impulse, self._place,
        )  # fmt: skip
        self._ask_air(
            state.velocity, state.triangles, air.share, air.source, air.velocity, air.inverse_mass, self._place
        )  # fmt: skip
        fastest, found = (float(value) for value in self._fastest.to_numpy())
        self._fastest_past, self._reaches_cloth = fastest, found > 0.0

    def resume(self) -> None:
        """Tell the restored cloth of the restored air."""
        self.follow(0.0)

    # --- what it is to the smoke ------------------------------------------------------------------------------------

    def stable_dt(self) -> float:
        """Step [s] in which the air passes a cloth that falls by `MOST_CELLS_PASSED` cells."""
        speed, distance = self._fastest_past, MOST_CELLS_PASSED * self._smoke.grid.cell_size
        fall = float(np.linalg.norm(self._cloth.gravity))
        return time_of_travel(distance, speed, fall) if self._reaches_cloth else math.inf

    def accelerate(self, dt: float) -> None:  # noqa: ARG002  (impulses are in place of forces)
        """Give the air what the last `exchange` collected."""
        if self._reaches_cloth:
            self._push_air()

    # --- kernels ----------------------------------------------------------------------------------------------------

    @ti.func
    def _corner(self, place, axis: ti.template()):
        """The lowest of the eight faces across an axis around a place in cells, and the offset from it in cells."""
        low = ti.Vector([0, 0, 0])
        offset = ti.Vector([0.0, 0.0, 0.0])
        for a in ti.static(range(3)):
            last = ti.static((self._nx, self._ny, self._nz)[a] + (a == axis))
            inside = ti.max(1.0, ti.min(place[a] + ti.static(1.0 if a == axis else 0.5), float(last)))
            low[a] = ti.max(1, ti.min(int(inside), last - 1))
            offset[a] = inside - low[a]
        return low[0] * self._step_x + low[1] * self._step_y + low[2], offset

    @ti.func
    def _weight(self, offset, n: ti.template()):
        """Trilinear weight of corner n, and how far it is from the lowest one in the arrays."""
        weight = 1.0
        for a in ti.static(range(3)):
            weight *= offset[a] if ti.static((n >> (2 - a)) & 1) else 1.0 - offset[a]
        return weight, ti.static((n >> 2) * self._step_x + (n >> 1 & 1) * self._step_y + (n & 1))

    @ti.func
    def _spread(self, sums: ti.template(), axis: ti.template(), place, value: ti.f32):
        """Add a value to the faces around a place; integers, so that the order does not matter."""
        at, offset = self._corner(place, axis)
        for n in ti.static(range(8)):
            weight, step = self._weight(offset, n)
            ti.atomic_add(sums[at + step], ti.round(weight * value / QUANTUM, ti.i64))

    @ti.kernel
    def _clear_sums(self):
        for at in range(self._size):
            for sums in ti.static((self._sums_x, self._sums_y, self._sums_z)):
                sums[at] = ti.cast(0, ti.i64)

    @ti.kernel
    def _find_triangles(
        self, position: Vectors, triangles: Triangles, density: Floats, wind: Vectors, source: Integers,
        velocity: Vectors, inverse_mass: Floats, impulse: Vectors, place: Vectors,
    ):  # fmt: skip
        """Which triangles are in the box, where, and how much of them shares the air of each face, A / (rho h³)."""
        origin, size = ti.static(self._smoke.grid.origin, self._smoke.grid.cell_size)
        end = ti.Vector([float(self._nx), float(self._ny), float(self._nz)])
        for t in range(triangles.shape[0]):
            x_a, x_b, x_c = position[triangles[t][0]], position[triangles[t][1]], position[triangles[t][2]]
            middle = ((x_a + x_b + x_c) / 3.0 - ti.Vector(origin)) / size
            if (middle >= 0.0).all() and (middle <= end).all() and density[t] > 0.0:
                place[t] = middle
                if source[t] != self._number:
                    source[t] = self._number
                    impulse[t] = ti.math.vec3(0.0)
                share = 0.5 * (x_b - x_a).cross(x_c - x_a).norm() / (density[t] * size**3)
                for axis, sums in ti.static(enumerate((self._sums_x, self._sums_y, self._sums_z))):
                    self._spread(sums, axis, middle, share)
            elif source[t] == self._number:
                source[t] = WIND
                velocity[t] = wind[t]
                inverse_mass[t] = 0.0

    @ti.kernel
    def _ask_air(
        self, node_velocity: Vectors, triangles: Triangles, node_share: Floats, source: Integers, velocity: Vectors,
        inverse_mass: Floats, place: Vectors,
    ):  # fmt: skip
        """Velocity of the air at each triangle in the box, and how little of it there is; the largest past a cloth."""
        for k in range(2):
            self._fastest[k] = 0.0
        for t in range(triangles.shape[0]):
            if source[t] == self._number:
                air = ti.math.vec3(0.0)
                reach = ti.math.vec3(0.0)
                for axis, face, sums in ti.static(
                    ((0, self._u, self._sums_x), (1, self._v, self._sums_y), (2, self._w, self._sums_z))
                ):
                    at, offset = self._corner(place[t], axis)
                    for n in ti.static(range(8)):
                        weight, step = self._weight(offset, n)
                        air[axis] += weight * face[at + step]
                        reach[axis] += weight * (ti.cast(sums[at + step], ti.f32) * QUANTUM)
                velocity[t] = air
                inverse_mass[t] = reach.max()
                past = air
                for k in ti.static(range(3)):
                    past -= node_share[triangles[t][k]] * node_velocity[triangles[t][k]]
                ti.atomic_max(self._fastest[0], past.norm())
                ti.atomic_max(self._fastest[1], 1.0)

    @ti.kernel
    def _collect_impulses(self, place: Vectors, source: Integers, density: Floats, impulse: Vectors):
        """Changes of the velocity of each face's air [m/s], -sum_t w_tf J_t / (rho h³); impulses start anew."""
        cell_volume = ti.static(self._smoke.grid.cell_size**3)
        for t in range(source.shape[0]):
            if source[t] == self._number and density[t] > 0.0:  # the air may have been taken away since, live
                change = -impulse[t] / (density[t] * cell_volume)
                for axis, sums in ti.static(enumerate((self._sums_x, self._sums_y, self._sums_z))):
                    self._spread(sums, axis, place[t], change[axis])
                impulse[t] = ti.math.vec3(0.0)

    @ti.kernel
    def _push_air(self):
        for at in range(self._size):
            for face, openness, sums in ti.static(
                (
                    (self._u, self._open_x, self._sums_x),
                    (self._v, self._open_y, self._sums_y),
                    (self._w, self._open_z, self._sums_z),
                )
            ):
                if openness[at] > 0.0:
                    face[at] += ti.cast(sums[at], ti.f32) * QUANTUM
