"""Where bodies touch, from step to step: pairs that are near are looked at again when they have moved."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from taichi.lang import impl

from sim.core.host_access import copied, put, viewed
from sim.core.motion.paths import Poses
from sim.core.reductions import runs_on_gpu
from sim.core.scan import scan_scratch_length
from sim.core.scheduling import LEAST_RUN
from sim.core.solver import Arrays
from sim.core.walls import Wall
from sim.rigid import collision_kernels as kernels
from sim.rigid.broad_phase import overlapping_pairs
from sim.rigid.collision_shapes import CollisionShapes
from sim.rigid.contacts import BODY_BITS, WALL_BITS, Array, Contacts, Indices, pair_keys, rows_of
from sim.rigid.polytope_kernels import find_polytope_contacts
from sim.rigid.tables import fill, kept, larger, larger_tables
from sim.shapes.body_geometry import BodyGeometry

STEPS_AHEAD, ROOM = 5.0, 0.05
"""Near pairs are searched for with room for the motion of so many steps, and for a part of their shortest edges."""
LARGEST_WORK = 1 << 25  # numbers that pairs need which a GPU looks at side by side
MOST_BLOCKS = 1 << 14  # of these pairs
ANY_BUDGET = 1.0e12  # motion that uses up what any pair has [m]
HASH = np.uint64(0x9E3779B97F4A7C15)  # 2^64 over the golden ratio
COLUMNS = {"pairs": 4, "features": 2, "planes": 6, "balls": 4, "forces": 3, "bodies": 2, "point": 3, "normal": 3}
"""Of arrays of pairs and of contacts."""


class CollisionDetector:
    """Finds the contacts of bodies with each other and with walls.

    Bodies are numbered: moving ones, static ones, and last the domain, which stands still at the origin. A pair is
    examined again when its surfaces may have moved by more than `TRUSTED_MOTION`, or one deforms; until then its
    contacts are followed (`collision_kernels.Kept`), all within that distance included.

    Attributes:
        deepest: overlap that was found last [m].
        untouching: keys of pairs of bodies that do not touch each other, as joints hold them, ascending.

    Raises:
        ValueError: there are too many bodies for the keys of contacts.
    """

    def __init__(self, geometries: Sequence[BodyGeometry], walls: Sequence[Wall], moving: int) -> None:
        """Take all bodies but the domain; so many of them move."""
        self._geometries, self._walls, self._moving = tuple(geometries), tuple(walls), moving
        self._domain = len(geometries)
        if self._domain >= 1 << BODY_BITS:
            raise ValueError(f"there are {self._domain:,} rigid bodies; at most {(1 << BODY_BITS) - 1:,} can meet")
        self._centre = np.stack([geometry.bounds.mean(axis=0) for geometry in geometries])
        self._half_edges = np.stack([0.5 * np.ptp(geometry.bounds, axis=0) for geometry in geometries])
        self._size = np.array([*(geometry.shortest_edge for geometry in geometries), kernels.FAR])
        self._deforms = np.array([*(geometry.deformation is not None for geometry in geometries), False])
        self._untouching = np.zeros(0, dtype=np.int64)
        self._pairs, self._outer = np.zeros((0, 4), dtype=np.int32), np.zeros((self._domain, 6))
        self._moved, self._must_search, self._is_renewed = np.zeros(self._domain + 1), True, False
        self._rows: Any = slice(0, 0)
        self._total, self.deepest, self._was_active = 0, 0.0, np.zeros(self._domain, dtype=bool)
        self._near = self._found = self._kept = self._spare = self._placed = self._scratch = None

    @property
    def untouching(self) -> Indices:
        """Keys of pairs of bodies that do not touch each other, as joints hold them, ascending."""
        return self._untouching

    @untouching.setter
    def untouching(self, keys: Indices) -> None:
        if not np.array_equal(keys, self._untouching):
            self._untouching, self._must_search = keys, True

    def touching(self, first: Indices, second: Indices) -> tuple[Indices, Indices]:
        """Those of some pairs of bodies, the lower number first, that may touch, (p,) each."""
        if not len(self.untouching):
            return first, second
        may = ~rows_of(pair_keys(first, second), self.untouching)[1]
        return first[may], second[may]

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The contacts that are being followed: bodies that rest on others than before would tremble."""
        starts, rows = self._followed()
        return {
            "near_pairs": self._pairs.copy(),
            "near_budgets": self._budgets(),
            # Boxes that are to be searched anew lie in none.
            "near_boxes": np.full_like(self._outer, kernels.FAR) if self._must_search else self._outer.copy(),
            "near_motion": self._moved.copy(),
            "contact_starts": starts,
            **{
                f"contact_{name}": copied(getattr(self._kept, name))[rows]
                if len(rows)
                else np.zeros((0, COLUMNS[name]))
                for name in ("features", "planes", "balls", "forces")
            },
        }

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing."""
        names = ("near_pairs", "near_budgets", "near_boxes", "near_motion", "contact_starts")
        rows = ("features", "planes", "balls", "forces")
        for name in (*names, *(f"contact_{each}" for each in rows)):
            if name not in arrays:
                raise ValueError(f"checkpoint of the rigid bodies: {name} is missing")
        pairs, budgets, outer, moved, starts = (np.array(arrays[name]) for name in names)
        self._take_pairs(pairs.astype(np.int32), np.full(len(pairs), -1), budgets)
        self._outer, self._moved, self._must_search = outer, moved, False
        put(self._outer_on_device, outer)
        self._total = int(starts[-1])
        self._kept = self._larger_kept(self._kept, self._total)
        fill(self._kept.starts, starts.astype(np.int32))
        for name in rows:
            fill(getattr(self._kept, name), np.array(arrays[f"contact_{name}"]))
        fill(self._near.before, np.arange(len(pairs), dtype=np.int32))

    def find(self, poses: Poses, motion: Array, is_active: NDArray[np.bool_], time_s: float = 0.0) -> None:
        """Find the contacts of all active bodies in poses, and in the shapes that they have at a time [s].

        The surface of each may get so far in the coming step if nothing stops it [m], (n + 1,). Those of the step
        before are preferred among equals. Contacts of bodies that are not active are kept.
        """
        self.look(poses, motion)
        bodies, count = self._bodies, len(self._pairs)
        put(bodies.moved, np.where(self._deforms, ANY_BUDGET, self._moved))
        put(bodies.is_active, np.append(is_active, False))
        self._moved = np.zeros(self._domain + 1)
        self._was_active, self._total, self.deepest = is_active, 0, 0.0
        if not count:
            return
        near, walls = self._near, self.walls
        tasks = kernels.choose_pairs(count, bodies, near, walls)
        self._shapes.deform(time_s)
        rows = tasks * kernels.MOST_KEPT
        self._found = larger_tables(kernels.Found, self._found, COLUMNS, rows, counts=tasks, clearances=tasks)
        if self._kept is None:
            self._kept = self._larger_kept(None, 0)
        for examine, is_there, tables, room, rows in (
            (find_polytope_contacts, self._shapes.has_polytopes, self._shapes.polytopes, self._shapes.most_vertices, 3),
            (kernels.find_contacts, self._shapes.has_others, self._shapes.on_device, self._shapes.most_balls, 1),
        ):
            if tasks and is_there:
                work, blocks = self._work(2 * room * rows)
                examine(tasks, bodies, near, self._kept, walls, tables, 2 * room, blocks, self._run, work, self._found)
        following = self._larger_kept(self._spare, 0)
        self._total = kernels.count_contacts(count, bodies, near, self._found, self._kept, following)
        following = self._larger_kept(following, self._total)
        self._placed = larger_tables(kernels.Placed, self._placed, COLUMNS, self._total)
        found = kernels.place_contacts(count, bodies, near, self._found, self._kept, following, self._placed)
        self.deepest = 1.0e-9 * found
        self._kept, self._spare = following, self._kept
        if self._is_renewed:
            fill(near.before, np.arange(count, dtype=np.int32))
            self._is_renewed = False

    def misses(self, velocity: Array, turning: Array, least: float) -> bool:
        """Whether bodies may meet in the step, of which contacts were not looked for as they got faster by others.

        Args:
            velocity: of all bodies times the step [m], (n + 1, 3).
            turning: how far their farthest points turn about centres of mass, or deform [m], (n + 1,).
            least: by how much farther than looked for they get at least, in shortest edges [-].
        """
        from sim.rigid.step_kernels import count_missed

        count, missed = len(self._pairs), np.zeros(1, dtype=np.int32)
        if count:
            count_missed(count, self._near.pairs, self._bodies, velocity, turning, least, missed)
        return bool(missed[0])

    def look(self, poses: Poses, motion: Array) -> None:
        """See to it that all pairs are known that may get near where surfaces may get so far [m], (n + 1,)."""
        put(self._bodies.pose, np.concatenate([poses.position, poses.rotation.reshape(-1, 9)], axis=1))
        put(self._bodies.motion, motion)
        if kernels.place_boxes(self._bodies, self._domain, self._outer_on_device) > 0 or self._must_search:
            self._search(poses, motion)

    def contacts(self) -> Contacts:
        """Those found last of active bodies, by pair, in order of the numbers of bodies."""
        self._rows = slice(0, self._total)
        if not self._total:
            nobody, nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
            return Contacts(nobody, nobody, np.zeros((0, 2), dtype=np.int32), nothing, nothing, nothing[:, 0], nothing)
        placed, kept = self._placed, self._kept
        bodies: NDArray[np.int32] = viewed(placed.bodies)[self._rows]
        if not self._was_active[: self._moving].all():
            among = np.append(self._was_active, False)
            self._rows = np.flatnonzero(among[bodies].any(axis=1))
            bodies = bodies[self._rows]
        features, point, normal, gap, force = (
            viewed(each)[self._rows] for each in (kept.features, placed.point, placed.normal, placed.gap, kept.forces)
        )
        first, second = bodies.astype(np.int64).T
        return Contacts(first, second, features, point, normal, gap, force)

    def active_count(self) -> int:
        """How many contacts were found last of active bodies."""
        if not self._total or self._was_active[: self._moving].all():
            return self._total
        among = np.append(self._was_active, False)
        return int(np.count_nonzero(among[viewed(self._placed.bodies)[: self._total]].any(axis=1)))

    def keep_forces(self, forces: Array) -> None:
        """Note forces of those that `contacts` gave last [N], (k, 3), from which the next step starts."""
        if self._total:
            everything: NDArray[np.float64] = viewed(self._kept.forces)
            everything[self._rows] = forces
            if runs_on_gpu():
                put(self._kept.forces, everything)

    @property
    def contact_count(self) -> int:
        """Of those found last, of all bodies."""
        return self._total

    @property
    def pair_count(self) -> int:
        """Of pairs that are near, or may get so soon."""
        return len(self._pairs)

    def on_device(self) -> tuple[Any, Any, Any, Any]:
        """What was found last: bundles of `collision_kernels.Near`, `Kept`, `Bodies` and `Placed`."""
        return self._near, self._kept, self._bodies, self._placed

    def follow(self, motion: Array) -> None:
        """Note how far the surface of each body got at most in the step just taken [m], (n + 1,)."""
        self._moved = self._moved + motion

    def overlapping(self, poses: Poses, motion: Array, is_active: NDArray[np.bool_]) -> tuple[Indices, Indices]:
        """Pairs of bodies whose boxes overlap with what surfaces may reach, and that may touch, (p,) each.

        One at least is active. Surfaces get so far in the step [m], (n + 1,).
        """
        self.look(poses, motion)
        lower, upper = self.boxes(poses)
        reach = ((kernels.CONTACT_BAND + kernels.TRUSTED_MOTION) * self._size[:-1] + motion[:-1])[:, None]
        lower, upper = lower - reach, upper + reach
        first, second = self._between
        found = is_active[first] | is_active[second]
        for axis in range(3):
            low, high = lower[:, axis], upper[:, axis]
            found &= (low[first] <= high[second]) & (low[second] <= high[first])
        return first[found], second[found]

    def boxes(self, poses: Poses) -> tuple[Array, Array]:
        """Lower and upper corners of all bodies' axis-aligned boxes [m], (n, 3) each."""
        turned = poses.rotation[:-1]
        centre = poses.position[:-1] + np.einsum("nij,nj->ni", turned, self._centre)
        half = np.einsum("nij,nj->ni", np.abs(turned), self._half_edges)
        return centre - half, centre + half

    def _search(self, poses: Poses, motion: Array) -> None:
        """The broad phase."""
        lower, upper = self.boxes(poses)
        reach = (kernels.CONTACT_BAND + kernels.TRUSTED_MOTION) * self._size[:-1] + motion[:-1]
        reach = (reach + STEPS_AHEAD * motion[:-1] + ROOM * (upper - lower).min(axis=1))[:, None]
        lower, upper = lower - reach, upper + reach
        moves = np.arange(self._domain) < self._moving
        first, second = self.touching(*overlapping_pairs(lower, upper, moves))
        parts = [np.stack([first, second, np.full(len(first), -1), self._shapes.sides(first, second)], axis=1)]
        for number, wall in enumerate(self._walls):
            depth = wall.offset - lower[:, wall.axis] if wall.side > 0.0 else upper[:, wall.axis] - wall.offset
            at = np.flatnonzero(moves & (depth >= 0.0))
            columns = (at, np.full(len(at), self._domain), np.full(len(at), number), self._shapes.sides_at_wall(at))
            parts.append(np.stack(columns, axis=1))
        pairs = np.concatenate(parts)
        keys = _keys_of(pairs)
        order = np.argsort(keys)
        before, budgets = np.full(len(pairs), -1), np.full(len(pairs), -kernels.FAR)
        if len(self._pairs):
            rows, is_known = rows_of(keys[order], _keys_of(self._pairs))
            # Contacts are of the pairs that they were last looked for in.
            numbers = np.arange(len(self._pairs))
            if self._is_renewed:
                numbers = viewed(self._near.before)[: len(self._pairs)]
            before[is_known], budgets[is_known] = numbers[rows[is_known]], self._budgets()[rows[is_known]]
        self._take_pairs(pairs[order].astype(np.int32), before, budgets)
        self._outer, self._must_search = np.concatenate([lower, upper], axis=1), False
        put(self._outer_on_device, self._outer)

    def _take_pairs(self, pairs: NDArray[np.int32], before: Indices, budgets: Array) -> None:
        """Look at other pairs from now on, which had these numbers before or -1, and have budgets [m]."""
        self._pairs = pairs
        first, second = pairs[pairs[:, 2] < 0, :2].astype(np.int64).T
        self._between = first, second
        count = len(pairs)
        sums = scan_scratch_length(2 * count + 1)
        self._near = larger_tables(kernels.Near, self._near, COLUMNS, count, place=count + 1, sums=sums)
        fill(self._near.pairs, pairs)
        fill(self._near.before, before.astype(np.int32))
        fill(self._near.budget, budgets)
        # Of Knuth's multiplicative hash. What never moves is counted from the end: other bodies change no order.
        of_hash = pairs.copy()
        of_hash[:, 1] += np.where(pairs[:, 1] < self._moving, 0, (1 << BODY_BITS) - 1 - self._domain)
        rank = np.empty(count, dtype=np.int32)
        rank[np.argsort(_keys_of(of_hash).astype(np.uint64) * HASH)] = np.arange(count)
        fill(self._near.rank, rank)
        self._is_renewed = True

    def _budgets(self) -> Array:
        return copied(self._near.budget)[: len(self._pairs)] if len(self._pairs) else np.zeros(0)

    def _followed(self) -> tuple[NDArray[np.int32], Indices]:
        """Where contacts of each of the pairs begin, and the end, (p + 1,), and which they are, (c,)."""
        if not self._total:
            return np.zeros(len(self._pairs) + 1, dtype=np.int32), np.zeros(0, dtype=np.int64)
        # They are of the pairs that they were last looked for in.
        before, starts = copied(self._near.before)[: len(self._pairs)], copied(self._kept.starts)
        counts = np.where(before >= 0, starts[before + 1] - starts[before], 0)
        ends = np.append(0, np.cumsum(counts))
        rows = np.repeat(starts[before] - ends[:-1], counts) + np.arange(ends[-1])
        return ends.astype(np.int32), rows

    # --- arrays on the device ---

    @cached_property
    def _shapes(self) -> CollisionShapes:
        return CollisionShapes(self._geometries)

    @cached_property
    def _bodies(self) -> kernels.Bodies:
        count = self._domain
        return kernels.Bodies(
            ti.ndarray(ti.f64, (count + 1, 12)),
            kept(self._shapes.of_body),
            kept(self._size),
            ti.ndarray(ti.f64, count + 1),
            ti.ndarray(ti.f64, count + 1),
            ti.ndarray(ti.i32, count + 1),
            kept(np.concatenate([self._centre, self._half_edges], axis=1)),
            ti.ndarray(ti.f64, (count, 6)),
        )

    @cached_property
    def _outer_on_device(self) -> ti.Ndarray:
        return kept(self._outer)

    @cached_property
    def walls(self) -> ti.Ndarray:
        """What kernels read of walls, see `collision_kernels.find_contacts`."""
        rows = [[each.axis, each.side, each.offset, *each.lower, *each.upper] for each in self._walls]
        return kept(np.array(rows or [[0.0] * 7]))

    @cached_property
    def _run(self) -> int:
        return 1 if runs_on_gpu() else LEAST_RUN

    def _work(self, rows: int) -> tuple[ti.Ndarray, int]:
        """Room for the candidates of pairs that are looked at side by side, so many rows each, and how many they are.

        On a CPU one a thread.
        """
        blocks = int(impl.current_cfg().cpu_max_num_threads)
        if runs_on_gpu():
            blocks = max(1, min(MOST_BLOCKS, LARGEST_WORK // (rows * kernels.SCRATCH)))
        self._scratch = larger(self._scratch, (blocks * rows, kernels.SCRATCH), ti.f64)
        return self._scratch, blocks

    def _larger_kept(self, tables: Any, contacts: int) -> Any:
        """Room for so many contacts of the pairs."""
        return larger_tables(kernels.Kept, tables, COLUMNS, contacts, starts=len(self._pairs) + 1)


def _keys_of(pairs: NDArray[np.integer]) -> Indices:
    """Numbers of pairs, (p,), in the order of their bodies, and of walls."""
    first, second, wall = pairs[:, :3].astype(np.int64).T
    return (pair_keys(first, second) << WALL_BITS) + wall + 1
