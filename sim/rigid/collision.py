"""Where bodies touch, from step to step: pairs that are near are looked at again when they have moved."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from taichi.lang import impl

from sim.core.motion.paths import Poses
from sim.core.reductions import runs_on_gpu
from sim.core.scheduling import LEAST_RUN
from sim.core.solver import Arrays
from sim.core.walls import Wall
from sim.rigid.broad_phase import NearBoxes
from sim.rigid.collision_shapes import CollisionShapes
from sim.rigid.contacts import BODY_BITS, AnchoredContacts, Array, Contacts, Indices, pair_keys, rows_of
from sim.shapes.body_geometry import BodyGeometry

CONTACT_BAND = 5.0e-3  # points this near, in shortest edges of the smaller body, belong to a contact
TRUSTED_MOTION = 1.0e-3  # contacts are looked for anew after surfaces moved so far, in the same unit
BLOCKS = 512  # of pairs that a GPU looks at side by side


class CollisionDetector:
    """Finds the contacts of bodies with each other and with walls.

    Bodies are numbered: moving ones, static ones, and last the domain, which stands still at the origin. A pair is
    examined again when its surfaces may have moved by more than `TRUSTED_MOTION`; until then its contacts are followed
    (`AnchoredContacts`), all within that distance included.

    Attributes:
        followed: the contacts that are being followed, by pair.
        untouching: keys of pairs of bodies that do not touch each other, as joints hold them, ascending.

    Raises:
        ValueError: there are too many bodies for the keys of contacts.
    """

    def __init__(self, geometries: Sequence[BodyGeometry], walls: Sequence[Wall]) -> None:
        """Take all bodies but the domain."""
        self._geometries, self._walls = tuple(geometries), tuple(walls)
        self._domain = len(geometries)
        if self._domain >= 1 << BODY_BITS:
            raise ValueError(f"there are {self._domain:,} rigid bodies; at most {(1 << BODY_BITS) - 1:,} can meet")
        self._centre = np.stack([geometry.bounds.mean(axis=0) for geometry in geometries])
        self._half_edges = np.stack([0.5 * np.ptp(geometry.bounds, axis=0) for geometry in geometries])
        self._size = np.array([*(geometry.shortest_edge for geometry in geometries), np.inf])
        self._pairs, self._budget = np.zeros(0, dtype=np.int64), np.zeros(0)
        self.followed = AnchoredContacts.joined([])
        self._boxes = NearBoxes()
        self.untouching = np.zeros(0, dtype=np.int64)

    def touching(self, first: Indices, second: Indices) -> tuple[Indices, Indices]:
        """Those of some pairs of bodies, the lower number first, that may touch, (p,) each."""
        if not len(self.untouching):
            return first, second
        may = ~rows_of(pair_keys(first, second), self.untouching)[1]
        return first[may], second[may]

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The contacts that are being followed: bodies that rest on others than before would tremble."""
        found = self.followed
        return {
            "near_pairs": self._pairs.copy(),
            "near_budgets": self._budget.copy(),
            "followed_numbers": np.stack([found.owner, found.other, found.side, found.feature], axis=1),
            "followed_places": np.concatenate(
                [found.centre, found.radius[:, None], found.anchor, found.outward], axis=1
            ),
        }

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing."""
        for name in ("near_pairs", "near_budgets", "followed_numbers", "followed_places"):
            if name not in arrays:
                raise ValueError(f"checkpoint of the rigid bodies: {name} is missing")
        self._pairs = np.array(arrays["near_pairs"], dtype=np.int64)
        self._budget = np.array(arrays["near_budgets"], dtype=np.float64)
        owner, other, side, feature = np.array(arrays["followed_numbers"], dtype=np.int64).reshape(-1, 4).T
        places = np.array(arrays["followed_places"], dtype=np.float64).reshape(-1, 10)
        self.followed = AnchoredContacts(
            owner, other, side, feature, places[:, :3], places[:, 3], places[:, 4:7], places[:, 7:]
        )

    def find(self, poses: Poses, motion: Array, last: Indices, is_active: NDArray[np.bool_]) -> Contacts:
        """The contacts of all active bodies in poses, by pair, in order of their numbers.

        The surface of each may get so far in the coming step if nothing stops it [m], (n + 1,). Those of the last step,
        by their ascending keys, are preferred among equals. Contacts of bodies that are not active are kept.
        """
        lower, upper = self.boxes(poses)
        first, second, wall = self._near(lower, upper, poses, motion, is_active)
        pairs, of_task = np.unique(pair_keys(first, second), return_inverse=True)
        ahead = motion[pairs >> BODY_BITS] + motion[pairs & ((1 << BODY_BITS) - 1)]
        budget = np.full(len(pairs), -np.inf)
        if len(self._pairs):
            rows, is_known = rows_of(pairs, self._pairs)
            budget[is_known] = self._budget[rows[is_known]]
        is_stale = ahead > budget

        # What no active body belongs to stays as it is.
        asleep = ~self._is_of(self._pairs, is_active)
        stays = np.concatenate([pairs[~is_stale], self._pairs[asleep]])
        owned = pair_keys(self.followed.first, self.followed.second)
        kept = self.followed.chosen(np.flatnonzero(np.isin(owned, stays)))
        tasks = np.flatnonzero(is_stale[of_task])
        found, clearance = self._examine(first[tasks], second[tasks], wall[tasks], poses, motion, last)
        clear = np.full(len(pairs), np.inf)
        np.minimum.at(clear, of_task[tasks], clearance - CONTACT_BAND * self._smaller(first[tasks], second[tasks]))
        budget = np.where(is_stale, clear, budget)
        if len(found) or len(kept) != len(self.followed):
            joined = AnchoredContacts.joined([kept, found])
            order = np.argsort(pair_keys(joined.first, joined.second), kind="stable")
            self.followed = joined.chosen(order)
        order = np.argsort(np.concatenate([pairs, self._pairs[asleep]]))
        self._budget = np.concatenate([budget, self._budget[asleep]])[order]
        self._pairs = np.concatenate([pairs, self._pairs[asleep]])[order]
        if not asleep.any():
            return self.followed.at(poses)
        owned = pair_keys(self.followed.first, self.followed.second)
        return self.followed.chosen(np.flatnonzero(self._is_of(owned, is_active))).at(poses)

    def follow(self, motion: Array) -> None:
        """Note how far the surface of each body got at most in the step just taken [m], (n + 1,)."""
        first, second = self.near()
        self._budget -= motion[first] + motion[second]

    def near(self) -> tuple[Indices, Indices]:
        """The pairs of bodies that were near in the last step, (p,) each; the domain is one."""
        return self._pairs >> BODY_BITS, self._pairs & ((1 << BODY_BITS) - 1)

    def boxes(self, poses: Poses) -> tuple[Array, Array]:
        """Lower and upper corners of all bodies' axis-aligned boxes [m], (n, 3) each."""
        turned = poses.rotation[:-1]
        centre = poses.position[:-1] + np.einsum("nij,nj->ni", turned, self._centre)
        half = np.einsum("nij,nj->ni", np.abs(turned), self._half_edges)
        return centre - half, centre + half

    @cached_property
    def _shapes(self) -> CollisionShapes:
        return CollisionShapes(self._geometries)

    @cached_property
    def _work(self) -> ti.Ndarray:
        from sim.rigid.collision_kernels import SCRATCH

        return ti.ndarray(ti.f64, (self._blocks * 2 * self._shapes.most_balls, SCRATCH))

    @cached_property
    def _own_work(self) -> ti.Ndarray:
        from sim.rigid.collision_kernels import SCRATCH

        return ti.ndarray(ti.f64, (self._blocks * 6 * self._shapes.most_vertices, SCRATCH))

    @cached_property
    def _blocks(self) -> int:
        """Of pairs that are looked at side by side: one a thread of a CPU."""
        return BLOCKS if runs_on_gpu() else int(impl.current_cfg().cpu_max_num_threads)

    @cached_property
    def _run(self) -> int:
        return 1 if runs_on_gpu() else LEAST_RUN

    def _is_of(self, pairs: Indices, is_active: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Whether one body of a pair is active, (k,)."""
        among = np.append(is_active, False)
        result: NDArray[np.bool_] = among[pairs >> BODY_BITS] | among[pairs & ((1 << BODY_BITS) - 1)]
        return result

    def _smaller(self, first: Indices, second: Indices) -> Array:
        """Shortest edge of the smaller body of pairs [m], (k,)."""
        return np.minimum(self._size[first], self._size[second])

    def _margin(self, first: Indices, second: Indices, motion: Array) -> Array:
        """Gap up to which contacts of pairs are looked for [m], (k,)."""
        return (CONTACT_BAND + TRUSTED_MOTION) * self._smaller(first, second) + motion[first] + motion[second]

    def _near(
        self, lower: Array, upper: Array, poses: Poses, motion: Array, is_active: NDArray[np.bool_]
    ) -> tuple[Indices, Indices, Indices]:
        """Pairs whose boxes are within their margins, and the wall that is meant, or -1: (k,) each, by pair."""
        reach = ((CONTACT_BAND + TRUSTED_MOTION) * self._size[:-1] + motion[:-1])[:, None]
        boxes = self._boxes.overlapping(lower - reach, upper + reach, motion[:-1], is_active)
        first, second = self.touching(*boxes)
        apart = np.maximum(lower[first] - upper[second], lower[second] - upper[first]).max(axis=1)
        near = apart <= self._margin(first, second, motion)
        pairs = [(first[near], second[near], np.full(np.count_nonzero(near), -1))]
        bodies = np.flatnonzero(is_active)
        margin = self._margin(bodies, np.full(len(bodies), self._domain), motion)
        for number, wall in enumerate(self._walls):
            apart = (
                lower[bodies, wall.axis] - wall.offset if wall.side > 0.0 else wall.offset - upper[bodies, wall.axis]
            )
            # A body that left by an open face falls on.
            inside = wall.side * (poses.position[bodies, wall.axis] - wall.offset) > 0.0
            at = bodies[(apart <= margin) & inside]
            pairs.append((at, np.full(len(at), self._domain), np.full(len(at), number)))
        first, second, wall_number = (np.concatenate(each) for each in zip(*pairs, strict=True))
        order = np.lexsort((wall_number, second, first))
        return first[order], second[order], wall_number[order]

    def _examine(
        self, first: Indices, second: Indices, wall: Indices, poses: Poses, motion: Array, last: Indices
    ) -> tuple[AnchoredContacts, Array]:
        """Contacts of some pairs that are near, and up to which gap [m] these are all of each pair."""
        clearance = self._margin(first, second, motion)
        shapes = self._shapes
        exact = shapes.are_polytopes(first) & ((wall >= 0) | shapes.are_polytopes(np.minimum(second, self._domain - 1)))
        parts = []
        for by_balls in (False, True):
            rows = np.flatnonzero(exact != by_balls)
            if len(rows):
                near = first[rows], second[rows], wall[rows], clearance[rows]
                part, clearance[rows] = self._examine_alike(*near, poses, last, by_balls)
                parts.append(part)
        return AnchoredContacts.joined(parts), clearance

    def _examine_alike(
        self, first: Indices, second: Indices, wall: Indices, margin: Array, poses: Poses, last: Indices, by_balls: bool
    ) -> tuple[AnchoredContacts, Array]:
        """Likewise, within gaps [m], (k,), of pairs that are all looked at as polytopes or all by their balls."""
        from sim.rigid.collision_kernels import MOST_KEPT, Bodies, Found, Tasks, find_contacts
        from sim.rigid.polytope_kernels import find_polytope_contacts

        shapes, count = self._shapes, len(first)
        sides = np.where(wall >= 0, 1, shapes.sides(first, np.minimum(second, self._domain - 1)))
        tasks = Tasks(
            np.ascontiguousarray(np.stack([first, second, wall, sides], axis=1), dtype=np.int32),
            margin,
        )
        bodies = Bodies(np.concatenate([poses.position, poses.rotation.reshape(-1, 9)], axis=1), shapes.of_body)
        walls = np.array(
            [[each.axis, each.side, each.offset, *each.lower, *each.upper] for each in self._walls] or [[0.0] * 7]
        )
        counts, room = np.zeros(count, dtype=np.int32), count * MOST_KEPT
        features, planes, balls = np.empty((room, 2), dtype=np.int32), np.empty((room, 6)), np.empty((room, 4))
        found = Found(counts, features, planes, np.empty(room), margin.copy())
        known = np.concatenate([[-1], last])
        if by_balls:
            room = 2 * shapes.most_balls
            find_contacts(
                tasks, bodies, walls, known, shapes.on_device, room, self._blocks, self._run, self._work, found
            )
        else:
            room = 2 * shapes.most_vertices
            find_polytope_contacts(
                tasks,
                bodies,
                walls,
                known,
                shapes.polytopes,
                room,
                self._blocks,
                self._run,
                self._own_work,
                found,
                balls,
            )
        task = np.repeat(np.arange(count), counts)
        rows = np.arange(len(task)) - np.repeat(np.cumsum(counts) - counts, counts) + MOST_KEPT * task
        side, feature = features[rows].astype(np.int64).T
        owner = np.where(side == 0, first[task], second[task])
        balls = shapes.balls_of(owner, feature) if by_balls else balls[rows]
        contacts = AnchoredContacts(
            owner=owner,
            other=np.where(side == 0, second[task], first[task]),
            side=side,
            feature=feature,
            centre=balls[:, :3],
            radius=balls[:, 3],
            anchor=planes[rows, :3],
            outward=planes[rows, 3:],
        )
        return contacts, found.clearances
