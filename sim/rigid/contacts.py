"""Contacts: points where two bodies touch, fixed to the bodies so that they can be followed, and how few of them do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from sim.core.motion.paths import Poses

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

BODY_BITS, FEATURE_BITS, WALL_BITS = 19, 24, 3
"""Of a contact's key: the first body, the second, which of the two the ball belongs to (one bit), and which it is.

The highest bits of a feature are the number of the wall that the ball meets."""

SAME_PATCH = 0.9  # normals closer than this cosine (26°) belong to one patch of contact
MOST_PATCHES = 4  # patches of one pair that are kept, deepest first: more normals than three hold a body in any pose
KEPT_BONUS = 2.0e-3  # head start, in extents of the patch, of points of the last step: equal ones must not take turns


@dataclass(frozen=True, eq=False)
class Contacts:
    """Points where bodies touch or are about to, as they are now."""

    first: Indices  # numbers of the two bodies, (k,)
    second: Indices
    keys: Indices  # what tells them apart from step to step, (k,)
    point: Array  # [m], (k, 3)
    normal: Array  # from the second to the first, (k, 3)
    gap: Array  # [m], (k,), negative where they overlap

    def __len__(self) -> int:
        return len(self.gap)


@dataclass(frozen=True, eq=False)
class AnchoredContacts:
    """Contacts as they were found: a ball fixed to one body against a plane fixed to the other.

    The plane touches the other body's surface where it is nearest to the ball. While the bodies move by a small part
    of their size it stands for that surface, with an error of the motion squared over the radius of curvature; for
    flat surfaces and walls it is exact, and a ball that rolls is followed exactly.
    """

    owner: Indices  # number of the body that the ball belongs to, (k,)
    other: Indices  # number of the body that the plane belongs to, (k,)
    side: Indices  # 0 if the owner is the first of the pair, else 1, (k,)
    feature: Indices  # number of the ball, (k,)
    centre: Array  # of the ball [m], in the owner's frame, (k, 3)
    radius: Array  # of the ball [m], (k,)
    anchor: Array  # a point of the plane [m], in the other's frame, (k, 3)
    outward: Array  # the plane's normal, in the other's frame, (k, 3)

    def __len__(self) -> int:
        return len(self.owner)

    @classmethod
    def joined(cls, parts: Sequence[AnchoredContacts]) -> AnchoredContacts:
        """All of them, in order; none if there are no parts."""
        if not parts:
            none = np.zeros(0, dtype=np.int64)
            return cls(none, none, none, none, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    def chosen(self, rows: Indices) -> AnchoredContacts:
        """Some of them."""
        return AnchoredContacts(*(getattr(self, field.name)[rows] for field in fields(self)))

    @property
    def first(self) -> Indices:
        """The first bodies of the pairs, (k,)."""
        return np.where(self.side == 0, self.owner, self.other)

    @property
    def second(self) -> Indices:
        """The second bodies, (k,)."""
        return np.where(self.side == 0, self.other, self.owner)

    def keys(self) -> Indices:
        """Number that tells a contact apart from step to step, (k,), in the order of the pairs."""
        pair = pair_keys(self.first, self.second)
        return (pair << (FEATURE_BITS + 1)) | (self.side << FEATURE_BITS) | self.feature

    def at(self, poses: Poses) -> Contacts:
        """The contacts where the bodies are now."""
        if not len(self):
            return Contacts(self.owner, self.other, self.owner, self.centre, self.centre, self.radius)
        turned = poses.rotation[self.other]
        outward = np.einsum("kij,kj->ki", turned, self.outward)
        anchor = poses.position[self.other] + np.einsum("kij,kj->ki", turned, self.anchor)
        centre = poses.position[self.owner] + np.einsum("kij,kj->ki", poses.rotation[self.owner], self.centre)
        height = np.einsum("ki,ki->k", outward, centre - anchor)
        return Contacts(
            first=self.first,
            second=self.second,
            keys=self.keys(),
            point=centre - self.radius[:, None] * outward,
            normal=np.where(self.side == 0, 1.0, -1.0)[:, None] * outward,
            gap=height - self.radius,
        )


def pair_keys(first: Indices, second: Indices) -> Indices:
    """Number of a pair of bodies, (k,), in the order of the first, then of the second."""
    return (first << BODY_BITS) | second


def bodies_of(keys: Indices) -> tuple[Indices, Indices]:
    """The first and the second bodies of contacts, by their keys, (k,) each."""
    return keys >> (FEATURE_BITS + 1 + BODY_BITS), (keys >> (FEATURE_BITS + 1)) & ((1 << BODY_BITS) - 1)


def rows_of(keys: Indices, known: Indices) -> tuple[Indices, NDArray[np.bool_]]:
    """Where keys stand among known ones, which ascend and are some, and whether they do, (k,) each."""
    rows = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    return rows, known[rows] == keys
