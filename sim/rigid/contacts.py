"""Contacts: points where two bodies touch, fixed to the bodies so that they can be followed, and how few of them do."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

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
    """Points where bodies touch or are about to, as they are now, those of two bodies one after the other."""

    first: Indices  # numbers of the two bodies, (k,)
    second: Indices
    features: NDArray[np.int32]  # what tells them apart from step to step: whose ball, 0 or 1, and which, (k, 2)
    point: Array  # [m], (k, 3)
    normal: Array  # from the second to the first, (k, 3)
    gap: Array  # [m], (k,), negative where they overlap
    force: Array  # of the last step [N], (k, 3)

    def __len__(self) -> int:
        return len(self.gap)

    def chosen(self, rows: Indices) -> Contacts:
        """Some of them."""
        return Contacts(*(getattr(self, field.name)[rows] for field in fields(self)))

    def keys(self) -> Indices:
        """Number that tells a contact apart, (k,), in the order of the pairs."""
        side, feature = self.features.astype(np.int64).T
        return (pair_keys(self.first, self.second) << (FEATURE_BITS + 1)) | (side << FEATURE_BITS) | feature


def pair_keys(first: Indices, second: Indices) -> Indices:
    """Number of a pair of bodies, (k,), in the order of the first, then of the second."""
    return (first << BODY_BITS) | second


def rows_of(keys: Indices, known: Indices) -> tuple[Indices, NDArray[np.bool_]]:
    """Where keys stand among known ones, which ascend and are some, and whether they do, (k,) each."""
    rows = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    return rows, known[rows] == keys
