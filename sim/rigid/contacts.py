"""Contacts: points where two bodies touch, fixed to the bodies so that they can be followed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from sim.core.motion.poses import Poses

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

Key = tuple[int, int, int]  # of a contact from step to step: the two bodies, and which ball of which of them
FEATURE_BITS = 32


@dataclass(frozen=True, eq=False)
class Contacts:
    """Points where bodies touch or are about to, as they are now."""

    first: Indices  # numbers of the two bodies, (k,)
    second: Indices
    keys: Indices  # what tells them apart from step to step, (k, 3) int64
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

    def keys(self) -> Indices:
        """Bodies, first and second, and feature with the side in its high bits, (k, 3)."""
        first = np.where(self.side == 0, self.owner, self.other)
        second = np.where(self.side == 0, self.other, self.owner)
        return np.stack([first, second, self.feature + (self.side << FEATURE_BITS)], axis=1)

    def at(self, poses: Poses) -> Contacts:
        """The contacts where the bodies are now."""
        if not len(self):
            return Contacts(self.owner, self.other, self.keys(), self.centre, self.centre, self.radius)
        turned = poses.rotation[self.other]
        outward = np.einsum("kij,kj->ki", turned, self.outward)
        anchor = poses.position[self.other] + np.einsum("kij,kj->ki", turned, self.anchor)
        centre = poses.position[self.owner] + np.einsum("kij,kj->ki", poses.rotation[self.owner], self.centre)
        height = np.einsum("ki,ki->k", outward, centre - anchor)
        keys = self.keys()
        return Contacts(
            first=keys[:, 0],
            second=keys[:, 1],
            keys=keys,
            point=centre - self.radius[:, None] * outward,
            normal=np.where(self.side == 0, 1.0, -1.0)[:, None] * outward,
            gap=height - self.radius,
        )


def tangent_basis(normal: Array) -> Array:
    """Two unit tangents a normal, (k, 2, 3), that depend on it continuously but at one pole (Duff et al. 2017)."""
    x, y, z = normal.T
    sign = np.where(z < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangents = np.empty((len(normal), 2, 3))
    tangents[:, 0, 0], tangents[:, 0, 1], tangents[:, 0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    tangents[:, 1, 0], tangents[:, 1, 1], tangents[:, 1, 2] = b, sign + y * y * a, -y
    return tangents
