"""Contacts of bodies whose parts touch for them: compounds, pieces that are glued together, hollow meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim.core.motion.paths import Poses
from sim.core.solver import Arrays
from sim.core.walls import Wall
from sim.rigid.collision import CollisionDetector
from sim.rigid.contacts import BODY_BITS, Array, Contacts, Indices, pair_keys, rows_of
from sim.shapes.body_geometry import BodyGeometry


class PartsDetector:
    """Finds contacts between the parts of bodies, which a `CollisionDetector` takes for bodies, and tells of bodies.

    Its methods are those of that one, of bodies.

    Attributes:
        movers: number of the body that each moves with, its own unless it is glued to others, and of the domain,
            (n + 1,). Contacts are told of movers; what moves together does not touch. Set it by `glue`.
        untouching: keys of pairs of bodies that do not touch each other, as joints hold them, ascending.
        pieces: the two bodies of each contact that was found last, whatever they move with, (k,) each.
    """

    def __init__(self, geometries: Sequence[BodyGeometry], walls: Sequence[Wall], moving: int) -> None:
        """Take all bodies but the domain; so many of them move."""
        parts = [part for geometry in geometries for part in geometry.contact_parts]
        count = len(geometries)
        self._of_part = np.array(
            [*(number for number, each in enumerate(geometries) for _ in each.contact_parts), count]
        )
        self._place = np.array([*(part.position for part in parts), np.zeros(3)])
        self._turn = np.array([*(part.rotation for part in parts), np.eye(3)])
        moving_parts = int(np.count_nonzero(self._of_part < moving))
        self._inner = CollisionDetector([part.geometry for part in parts], walls, moving_parts)
        self.movers, self._joined = np.arange(count + 1), np.zeros(0, dtype=np.int64)
        self.pieces = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
        self.glue(self.movers[:-1])

    @property
    def untouching(self) -> Indices:
        """Keys of pairs of bodies that joints keep from touching, ascending."""
        return self._joined

    @untouching.setter
    def untouching(self, keys: Indices) -> None:
        self._joined = keys
        self._tell()

    def glue(self, leaders: Indices) -> None:
        """Let bodies move with others, (n,)."""
        self.movers = np.append(leaders, len(leaders))
        self._tell()

    def _tell(self) -> None:
        """Tell what looks for contacts which parts do not touch: those of one mover, and of bodies that joints hold."""
        keys = [_pairs_within(self.movers[self._of_part])]
        if len(self._joined):
            members = np.argsort(self._of_part, kind="stable")
            starts = np.searchsorted(self._of_part[members], np.arange(len(self.movers) + 1))
            for first, second in zip(self._joined >> BODY_BITS, self._joined & ((1 << BODY_BITS) - 1), strict=True):
                one, two = (members[starts[each] : starts[each + 1]] for each in (first, second))
                keys.append(pair_keys(np.repeat(one, len(two)), np.tile(two, len(one))))
        self._inner.untouching = np.unique(np.concatenate(keys))

    def touching(self, first: Indices, second: Indices) -> tuple[Indices, Indices]:
        """Those of some pairs of bodies, the lower number first, that may touch, (p,) each."""
        may: NDArray[np.bool_] = self.movers[first] != self.movers[second]
        if len(self._joined):
            may &= ~rows_of(pair_keys(first, second), self._joined)[1]
        return first[may], second[may]

    def find(self, poses: Poses, motion: Array, is_active: NDArray[np.bool_], time_s: float = 0.0) -> None:
        """Find the contacts of all active bodies in poses, and at a time [s]."""
        self._inner.find(self._of_parts(poses), motion[self._of_part], is_active[self._of_part[:-1]], time_s)

    def misses(self, velocity: Array, turning: Array, least: float) -> bool:
        """Whether parts may meet in the step, of which contacts were not looked for."""
        return self._inner.misses(velocity[self._of_part], turning[self._of_part], least)

    def contacts(self) -> Contacts:
        """Those found last of active bodies, by pair of parts, told of movers."""
        found = self._inner.contacts()
        self.pieces = self._of_part[found.first], self._of_part[found.second]
        return replace(found, first=self.movers[self.pieces[0]], second=self.movers[self.pieces[1]])

    def active_count(self) -> int:
        """How many contacts were found last of active bodies."""
        return self._inner.active_count()

    def keep_forces(self, forces: Array) -> None:
        """Note forces of those that `contacts` gave last [N], (k, 3), from which the next step starts."""
        self._inner.keep_forces(forces)

    @property
    def deepest(self) -> float:
        """Overlap that was found last [m]."""
        return self._inner.deepest

    def follow(self, motion: Array) -> None:
        """Note how far the surface of each body got at most in the step just taken [m], (n + 1,)."""
        self._inner.follow(motion[self._of_part])

    def overlapping(self, poses: Poses, motion: Array, is_active: NDArray[np.bool_]) -> tuple[Indices, Indices]:
        """Pairs of bodies of which parts have boxes that overlap with what surfaces may reach, (p,) each."""
        among = is_active[self._of_part[:-1]]
        first, second = self._inner.overlapping(self._of_parts(poses), motion[self._of_part], among)
        keys = np.unique(pair_keys(self._of_part[first], self._of_part[second]))
        return keys >> BODY_BITS, keys & ((1 << BODY_BITS) - 1)

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The contacts that are being followed."""
        return self._inner.checkpoint()

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing."""
        self._inner.restore(arrays)

    def _of_parts(self, poses: Poses) -> Poses:
        """Poses of the parts, of those of bodies."""
        turned = poses.rotation[self._of_part]
        arms = np.einsum("nij,nj->ni", turned, self._place)
        return Poses(poses.position[self._of_part] + arms, turned @ self._turn)


def detector_of(
    geometries: Sequence[BodyGeometry], walls: Sequence[Wall], moving: int
) -> CollisionDetector | PartsDetector:
    """Who finds the contacts of some bodies, all but the domain, of which so many move."""
    if any(geometry.contact_parts[0].geometry is not geometry for geometry in geometries):
        return PartsDetector(geometries, walls, moving)
    return CollisionDetector(geometries, walls, moving)


def _pairs_within(numbers: Indices) -> Indices:
    """Keys of all pairs of members, the lower number first, that have the same number of a group, ascending."""
    order = np.argsort(numbers, kind="stable")
    begins = np.flatnonzero(np.append(True, np.diff(numbers[order]) != 0))
    keys = [np.zeros(0, dtype=np.int64)]
    for begin, end in zip(begins, np.append(begins[1:], len(order)), strict=True):
        if end - begin > 1:
            one, two = np.triu_indices(end - begin, 1)
            keys.append(pair_keys(order[begin + one], order[begin + two]))
    return np.sort(np.concatenate(keys))
