"""Where bodies touch: the balls of one against the distance of the other, looked for again when they have moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.core.motion.paths import Poses
from sim.core.walls import Wall
from sim.rigid.contacts import BODY_BITS, AnchoredContacts, Array, Contacts, Indices, reduce_manifold
from sim.shapes.body_geometry import BodyGeometry

CONTACT_BAND = 5.0e-3  # points this near, in shortest edges of the smaller body, belong to a contact
TRUSTED_MOTION = 1.0e-3  # contacts are looked for anew after surfaces moved so far, in the same unit
SLANT = 0.03  # how far outside of a ball's cone a contact normal may be [rad]
SLANT_ON_GRIDS = 0.3  # likewise, on distance grids, whose normals are no better than this [rad]


class CollisionDetector:
    """Finds the contacts of bodies with each other and with walls.

    Bodies are numbered: moving ones, static ones, and last the domain, which stands still at the origin. A pair is
    examined again when its surfaces may have moved by more than `TRUSTED_MOTION`; until then its contacts are followed
    (`AnchoredContacts`), all within that distance included.

    Attributes:
        followed: the contacts that are being followed.
    """

    def __init__(self, geometries: Sequence[BodyGeometry], can_move: NDArray[np.bool_], walls: Sequence[Wall]) -> None:
        """Take all bodies but the domain, and which of them forces move, (n,): pairs without one have no contacts."""
        self._geometries, self._walls = tuple(geometries), tuple(walls)
        self._domain = len(geometries)
        if self._domain >= 1 << BODY_BITS:
            raise ValueError(f"there are {self._domain:,} rigid bodies; at most {(1 << BODY_BITS) - 1:,} can meet")
        self._closed = np.array([[-np.inf] * 3, [np.inf] * 3])
        for wall in walls:
            self._closed[0 if wall.side > 0.0 else 1, wall.axis] = wall.offset
        self._centre = np.stack([geometry.bounds.mean(axis=0) for geometry in geometries])
        self._half_edges = np.stack([0.5 * np.ptp(geometry.bounds, axis=0) for geometry in geometries])
        size = np.array([geometry.shortest_edge for geometry in geometries])
        first, second = np.triu_indices(len(geometries), k=1)
        meets = can_move[first] | can_move[second]
        at_walls = np.flatnonzero(can_move)
        self._first = np.concatenate([first[meets], at_walls])
        self._second = np.concatenate([second[meets], np.full(len(at_walls), self._domain)])
        smaller = np.minimum(size[self._first], np.append(size, np.inf)[self._second])
        self._band, self._trusted = CONTACT_BAND * smaller, TRUSTED_MOTION * smaller
        self.forget()

    def forget(self) -> None:
        """Examine every pair anew at the next step."""
        self._budget = np.full(len(self._first), -np.inf)
        self._found: list[list[AnchoredContacts]] = [[] for _ in self._first]
        self.followed = AnchoredContacts.joined([])

    def find(self, poses: Poses, motion: Array, last: Indices) -> Contacts:
        """The contacts of all bodies in poses, by pair, in order of their numbers, then those at walls.

        The surface of each may get so far in the coming step if nothing stops it [m], (n + 1,). Those of the last step,
        by their keys, are preferred among equals.
        """
        ahead = motion[self._first] + motion[self._second]
        stale = np.flatnonzero(ahead > self._budget)
        if len(stale):
            margin = self._band + self._trusted + ahead
            separation = self._separations(stale, poses)
            near = separation <= margin[stale]
            if self._examine(stale[near], poses, margin, last) | self._drop(stale[~near]):
                self.followed = AnchoredContacts.joined([part for parts in self._found for part in parts])
            # Boxes that are apart touch no sooner than they have come together.
            apart = separation - self._band[stale]
            self._budget[stale] = np.where(near, self._trusted[stale] + ahead[stale], apart)
        return self.followed.at(poses)

    def follow(self, motion: Array) -> None:
        """Note how far the surface of each body got at most in the step just taken [m], (n + 1,)."""
        self._budget -= motion[self._first] + motion[self._second]

    def _separations(self, pairs: Indices, poses: Poses) -> Array:
        """Lower bounds of the distances of some pairs [m], from their axis-aligned boxes; walls are planes."""
        lower, upper = self._boxes(poses)
        first, second = self._first[pairs], self._second[pairs]
        walls = second == self._domain
        partner = np.where(walls, 0, second)
        between = np.maximum(lower[first] - upper[partner], lower[partner] - upper[first]).max(axis=1)
        to_walls = np.minimum(lower[first] - self._closed[0], self._closed[1] - upper[first]).min(axis=1)
        return np.where(walls, to_walls, between)

    def _boxes(self, poses: Poses) -> tuple[Array, Array]:
        """Lower and upper corners of all bodies' axis-aligned boxes [m], (n, 3) each."""
        turned = poses.rotation[:-1]
        centre = poses.position[:-1] + np.einsum("nij,nj->ni", turned, self._centre)
        half = np.einsum("nij,nj->ni", np.abs(turned), self._half_edges)
        return centre - half, centre + half

    def _drop(self, pairs: Indices) -> bool:
        """Forget the contacts of pairs that are apart; whether there were any."""
        dropped = [pair for pair in pairs.tolist() if self._found[pair]]
        for pair in dropped:
            self._found[pair] = []
        return bool(dropped)

    def _examine(self, pairs: Indices, poses: Poses, margin: Array, last: Indices) -> bool:
        """Look for the contacts of some pairs that are near; whether there are, or were, any."""
        changed = False
        for pair in pairs.tolist():
            a, b, within = int(self._first[pair]), int(self._second[pair]), float(margin[pair])
            if b == self._domain:
                found = self._at_walls(a, poses, within, last)
            else:
                found = self._between(a, b, poses, within, last)
            changed |= bool(found) or bool(self._found[pair])
            self._found[pair] = found
        return changed

    def _between(self, a: int, b: int, poses: Poses, margin: float, last: Indices) -> list[AnchoredContacts]:
        """Contacts of two bodies: the balls of each against the distance of the other."""
        sides = [(0, a, b), (1, b, a)]
        for one_side in sides:
            if self._geometries[one_side[1]].sees_all_contacts_with(self._geometries[one_side[2]]):
                sides = [one_side]
                break
        candidates = []
        for side, owner, other in sides:
            balls, obstacle = self._geometries[owner].balls, self._geometries[other]
            relative = poses.rotation[other].T @ poses.rotation[owner]
            shift = (poses.position[owner] - poses.position[other]) @ poses.rotation[other]
            centres = _transform(relative, balls.centres, shift)
            low, high = obstacle.bounds
            outside = margin + balls.radii
            is_near = balls.radii <= obstacle.reach
            for axis in range(3):
                is_near &= (centres[axis] >= low[axis] - outside) & (centres[axis] <= high[axis] + outside)
            near = np.flatnonzero(is_near)
            if not len(near):
                continue
            points = np.ascontiguousarray(centres[:, near].T)
            distance = obstacle.contact_distance(points)
            touching = distance <= margin + balls.radii[near]
            near, points, distance = near[touching], points[touching], distance[touching]
            if not len(near):
                continue
            outward = obstacle.contact_normal(points)
            axes = _transform(relative, balls.axes[:, near], np.zeros(3))
            slant = np.arccos(np.clip(-np.einsum("ik,ki->k", axes, outward), -1.0, 1.0))
            facing = slant <= balls.cones[near] + (SLANT if obstacle.is_analytic else SLANT_ON_GRIDS)
            near, points, distance, outward = near[facing], points[facing], distance[facing], outward[facing]
            if not len(near):
                continue
            candidates.append(
                AnchoredContacts(
                    owner=np.full(len(near), owner),
                    other=np.full(len(near), other),
                    side=np.full(len(near), side),
                    feature=near,
                    centre=balls.centres[:, near].T,
                    radius=balls.radii[near],
                    anchor=points - distance[:, None] * outward,
                    outward=outward,
                )
            )
        return _reduced(AnchoredContacts.joined(candidates), poses, last, margin) if candidates else []

    def _at_walls(self, body: int, poses: Poses, margin: float, last: Indices) -> list[AnchoredContacts]:
        """Contacts of a body with the walls."""
        lower, upper = (corner[body] for corner in self._boxes(poses))
        walls = [
            (number, wall)
            for number, wall in enumerate(self._walls)
            if wall.distance(lower, upper) <= margin and wall.holds(poses.position[body])
        ]
        if not walls:
            return []
        balls = self._geometries[body].balls
        centres = _transform(poses.rotation[body], balls.centres, poses.position[body])
        found = []
        for number, wall in walls:
            height = wall.side * (centres[wall.axis] - wall.offset)
            near = np.flatnonzero((height <= margin + balls.radii) & wall.is_beside(centres))
            if not len(near):
                continue
            normals = np.tile(wall.normal, (len(near), 1))
            candidates = AnchoredContacts(
                owner=np.full(len(near), body),
                other=np.full(len(near), self._domain),
                side=np.zeros(len(near), dtype=np.int64),
                feature=near + number * len(balls.radii),
                centre=balls.centres[:, near].T,
                radius=balls.radii[near],
                anchor=wall.offset * wall.side * normals,
                outward=normals,
            )
            found += _reduced(candidates, poses, last, margin)
        return found


def _transform(rotation: Array, points: Array, shift: Array) -> Array:
    """Turned and moved points, (3, m)."""
    x, y, z = points
    moved = np.empty_like(points)
    for i in range(3):
        moved[i] = rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] * z + shift[i]
    return moved


def _reduced(candidates: AnchoredContacts, poses: Poses, last: Indices, margin: float) -> list[AnchoredContacts]:
    return [candidates.chosen(reduce_manifold(candidates.at(poses), last, margin=margin))]
