"""Steps of bodies: which may meet within a step, how far they may get until then, and who shares steps of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sim.core.motion.paths import Poses
from sim.core.walls import Wall
from sim.rigid.collision import CollisionDetector
from sim.rigid.contacts import Array, Indices
from sim.rigid.parts import PartsDetector
from sim.rigid.states import MovingBodies, lengths
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.primitives import Sphere

LARGEST_ADVANCE = 0.25
"""How far surfaces may get in a step, in half shortest edges of the smaller dynamic body of two that may meet; a body
that nothing is near may get half of the way to what is nearest."""

LARGEST_TURN = 0.1  # how far bodies may turn in a step [rad]: rotation errs by about a tenth of its square
FAR = 1.0e30  # more than any way [m]
MOST_OWN_STEPS = 1000  # of a group within a step; beyond, the step of all bodies gets shorter


@dataclass(frozen=True, eq=False)
class Meetings:
    """Who may meet whom within a step."""

    first: Indices  # numbers of two bodies whose bounds overlap somewhere in the step, the lower first, (p,)
    second: Indices
    time_s: Array  # in which the two get as far as a step may take them [s], (p,)
    alone_s: Array  # likewise each moving body, by its turning and by the walls, (n,)


class StepChooser:
    """How long steps of bodies may be; gravity is in m/s².

    Attributes:
        links: pairs of moving bodies that joints hold together, (l,) each: they take the same steps.
    """

    def __init__(
        self,
        geometries: Sequence[BodyGeometry],
        bodies: MovingBodies,
        walls: Sequence[Wall],
        detector: CollisionDetector | PartsDetector,
        gravity: Array,
    ) -> None:
        """Take the moving bodies, which come first among the geometries."""
        self._geometries, self._bodies, self._walls = tuple(geometries), bodies, tuple(walls)
        self._detector, self._gravity = detector, gravity
        # Of all bodies, the domain last.
        self._radius = np.array([*(geometry.radius for geometry in geometries), 0.0])
        self._edge = np.array([geometry.shortest_edge for geometry in geometries])
        is_dynamic = np.append(bodies.is_dynamic, np.zeros(len(geometries) - len(bodies), dtype=bool))
        self._advance = np.append(np.where(is_dynamic, LARGEST_ADVANCE * 0.5 * self._edge, FAR), FAR)
        is_ball = [
            isinstance(each.solid.shape, Sphere) and np.abs(each.centre_of_mass).max() < 1.0e-9 * each.radius
            for each in geometries
        ]
        self._ball = np.append(np.where(is_ball, 0.5 * self._edge, FAR), FAR)  # radii of what may bounce within a step
        self._middle = np.array([_half_way(wall, walls) for wall in walls] or [FAR])
        self.links = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))

    def meetings(
        self,
        poses: Poses,
        dt: float,
        is_active: NDArray[np.bool_],
        speeds: Array | None = None,
        *,
        has_own_steps: bool = True,
    ) -> Meetings:
        """The meetings of active bodies, (n,), within dt [s]; speeds of surfaces [m/s], (n,), their own if omitted.

        Where nobody has steps of their own balls do not bounce within a step either: it is shared by what they push.
        """
        bodies, n = self._bodies, len(self._bodies)
        acceleration = float(np.linalg.norm(self._gravity))
        spin = bodies.spins()
        own = bodies.surface_speeds(self._radius[:n])
        motion = np.zeros(len(self._edge) + 1)
        motion[:n] = (own if speeds is None else speeds) * dt + 0.5 * acceleration * dt * dt
        among = np.append(is_active, np.zeros(len(self._edge) - n, dtype=bool))
        first, second = self._detector.overlapping(poses, motion, among)

        velocity = np.concatenate([bodies.velocity, np.zeros((len(self._edge) - n, 3))])
        turning = np.append(spin * self._radius[:n] + bodies.deforming, np.zeros(len(self._edge) - n))
        all_speeds = np.append(own, np.zeros(len(self._edge) - n))
        relative = lengths(velocity[first] - velocity[second]) + turning[first] + turning[second]
        slower, faster = np.sort([all_speeds[first], all_speeds[second]], axis=0)
        # The sum of both advances goes by the speed of one against the other.
        advance = np.minimum(self._advance[first], self._advance[second])
        advance *= 1.0 + slower / np.maximum(faster, 1.0e-30)
        time_s = time_of(advance, relative, acceleration)
        fast = np.flatnonzero(time_s < dt)
        room = self._rooms(first[fast], second[fast], poses)
        time_s[fast] = time_of(np.maximum(advance[fast], 0.5 * room), relative[fast], acceleration)

        alone_s = np.divide(LARGEST_TURN, spin, out=np.full(n, np.inf), where=spin > 0.0)
        for wall, middle in zip(self._walls, self._middle, strict=False):
            height = wall.side * (bodies.position[:, wall.axis] - wall.offset)
            along = np.delete(bodies.position, wall.axis, axis=1)
            aside = np.maximum(wall.lower - along, along - wall.upper).max(axis=1)
            # Who left by an open face falls on, past the edges of the wall.
            meets = bodies.is_dynamic & (height > 0.0) & (aside <= self._radius[:n] + motion[:n])
            advance = np.maximum(self._advance[:n], 0.5 * (height - self._radius[:n]))
            if has_own_steps:
                advance = np.maximum(advance, middle - self._ball[:n])
            # Along a plane it may get as far as it likes.
            towards = np.abs(bodies.velocity[:, wall.axis]) + spin * self._radius[:n] + bodies.deforming
            by_wall = time_of(advance, towards, acceleration)
            alone_s = np.where(meets, np.minimum(alone_s, by_wall), alone_s)
        return Meetings(first, second, time_s, alone_s)

    def needs_none(self, dt: float) -> bool:
        """Whether a look at the speeds tells that no body may get too far in dt [s], whatever it meets."""
        bodies, n = self._bodies, len(self._bodies)
        spin = float(bodies.spins().max())
        fastest = float(bodies.surface_speeds(self._radius[:n]).max())
        smallest = float(self._advance.min())
        gravity = float(np.linalg.norm(self._gravity))
        return spin * dt <= LARGEST_TURN and float(time_of(smallest, 2.0 * fastest, gravity)) >= dt

    def divided(self, poses: Poses, dt: float, is_active: NDArray[np.bool_]) -> list[tuple[int, NDArray[np.bool_]]]:
        """Numbers of steps that a step of dt [s] is made of, each with the dynamic bodies, (n,), that take so many.

        Bodies that may meet take the same steps; a fast one shortens those of nobody else. In groups that divide it
        each body may get as fast as the fastest.
        """
        bodies = self._bodies
        is_free = bodies.is_free & is_active
        if not is_free.any():
            return []
        if self.needs_none(dt):
            return [(1, is_free)]
        if isinstance(self._detector, CollisionDetector) and self._is_calm(self._detector, poses, dt, is_free):
            return [(1, is_free)]
        groups, counts = self._counts(self.meetings(poses, dt, is_active), dt, is_free)
        speeds = bodies.surface_speeds(self._radius[: len(bodies)])
        fastest = np.zeros(len(bodies))
        np.maximum.at(fastest, groups, np.where(is_free, speeds, 0.0))
        faster = np.where(counts > 1, fastest[groups], speeds)
        if np.any(faster > speeds):
            _, counts = self._counts(self.meetings(poses, dt, is_active, faster), dt, is_free)
        return [(int(count), is_free & (counts == count)) for count in np.unique(counts[is_free])]

    def _is_calm(self, detector: CollisionDetector, poses: Poses, dt: float, is_free: NDArray[np.bool_]) -> bool:
        """Whether no free body may get too far in dt [s]: a look from above at what `meetings` finds exactly."""
        from sim.rigid.step_kernels import Speeds, count_fast

        bodies, n = self._bodies, len(self._bodies)
        acceleration = float(np.linalg.norm(self._gravity))
        spin = bodies.spins()
        if float(np.max(spin, where=is_free, initial=0.0)) * dt > LARGEST_TURN:
            return False
        still = len(self._edge) + 1 - n
        own = bodies.surface_speeds(self._radius[:n])
        motion = np.append(own * dt + 0.5 * acceleration * dt * dt, np.zeros(still))
        detector.look(poses, motion)
        speeds = Speeds(
            np.concatenate([bodies.velocity, np.zeros((still, 3))]),
            np.append(spin * self._radius[:n] + bodies.deforming, np.zeros(still)),
            np.append(own, np.zeros(still)),
            self._advance,
            np.append(is_free, np.zeros(still)).astype(np.int32),
            self._radius,
            self._ball,
        )
        near, _, moving, _ = detector.on_device()
        if not detector.pair_count:
            return True
        fast = np.zeros(1, dtype=np.int32)
        walls = detector.walls, self._middle
        count_fast(detector.pair_count, near.pairs, moving, *walls, speeds, dt, acceleration, fast)
        return not fast[0]

    def _counts(self, meetings: Meetings, dt: float, is_free: NDArray[np.bool_]) -> tuple[Indices, Indices]:
        """The group of each body, and how many steps it takes in dt [s], (n,) each."""
        n = len(is_free)
        free = np.append(is_free, np.zeros(len(self._edge) - n, dtype=bool))
        first, second = (
            np.concatenate(each) for each in zip((meetings.first, meetings.second), self.links, strict=True)
        )
        links = free[first] & free[second]
        groups = groups_of(first[links], second[links], n)
        time_s = np.full(n, np.inf)
        np.minimum.at(time_s, groups[is_free], meetings.alone_s[is_free])
        for one, two in ((meetings.first, meetings.second), (meetings.second, meetings.first)):
            mine = free[one]
            np.minimum.at(time_s, groups[one[mine]], meetings.time_s[mine])
            moving = mine & (two < n)
            np.minimum.at(time_s, groups[one[moving]], meetings.alone_s[two[moving]])
        counts = np.ceil(dt / time_s * (1.0 - 1.0e-9)).clip(1, MOST_OWN_STEPS).astype(np.int64)
        return groups, np.where(is_free, counts[groups], 1)

    def _rooms(self, first: Indices, second: Indices, poses: Poses) -> Array:
        """Distances of pairs [m], (k,), at least: of spheres around bodies, or from one to an exact static shape."""
        away = poses.position[first] - poses.position[second]
        room = lengths(away) - self._radius[second]
        for number in np.unique(second[second >= len(self._bodies)]):
            geometry, mine = self._geometries[number], second == number
            if geometry.is_analytic:
                room[mine] = geometry.signed_distance(away[mine] @ poses.rotation[number])
        result: Array = room - self._radius[first]
        return result


def _half_way(wall: Wall, walls: Sequence[Wall]) -> float:
    """Half of the way from a wall to the one that faces it [m], however far that is."""
    facing = (abs(each.offset - wall.offset) for each in walls if (each.axis, each.side) == (wall.axis, -wall.side))
    return 0.5 * next(facing, 2.0 * FAR)


def groups_of(first: Indices, second: Indices, count: int) -> Indices:
    """Numbers of the groups of so many bodies that pairs, (p,), link, (count,)."""
    links = coo_matrix((np.ones(len(first), dtype=np.int8), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)


def time_of(advance: Array | float, speed: Array | float, acceleration: float) -> Array:
    """Time [s] in which v dt + g dt² is an advance [m], for speeds [m/s] and an acceleration [m/s²]."""
    root = speed + np.sqrt(np.square(speed) + 4.0 * acceleration * np.asarray(advance))
    return 2.0 * advance / np.maximum(root, 1.0e-300)
