"""A few contacts of a pair of bodies that hold it as all of them would."""

from __future__ import annotations

import numpy as np

from sim.rigid.contacts import Array, Contacts, Indices, Key, tangent_basis

SAME_PATCH = 0.9
"""Normals closer than this cosine (26°) belong to one patch of contact."""

MOST_PATCHES = 4
"""Patches of one pair that are kept, deepest first: more normals than three hold a body in any pose."""

KEPT_BONUS = 2.0e-3
"""Head start, in extents of the patch, of points of the last step: equal ones must not take turns."""

_ANGLES = 2.0 * np.pi * (np.arange(8) + 0.29) / 8.0
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Eight directions find every corner of a convex patch with an angle under 135°; the offset avoids symmetry axes."""


def reduce_manifold(contacts: Contacts, last: frozenset[Key]) -> Indices:
    """Rows of the contacts to keep: by patches of like normals, deepest first; ascending within a patch.

    Args:
        contacts: of one pair, one at least.
        last: keys of the last step's contacts, which are preferred among equals.
    """
    kept = []
    remaining = np.arange(len(contacts))
    for _ in range(MOST_PATCHES):
        deepest = remaining[np.argmin(contacts.gap[remaining])]
        normal = contacts.normal[deepest]
        alike = contacts.normal[remaining] @ normal >= SAME_PATCH
        kept.append(_corners(contacts, remaining[alike], deepest, normal, last))
        remaining = remaining[~alike]
        if not len(remaining):
            break
    return np.concatenate(kept)


def _corners(contacts: Contacts, patch: Indices, deepest: np.int64, normal: Array, last: frozenset[Key]) -> Indices:
    """The deepest point of a patch and the outermost in eight directions along it."""
    if len(patch) <= 2:
        return patch
    along = (contacts.point[patch] @ tangent_basis(normal[None])[0].T) @ _DIRECTIONS
    if last:
        kept = np.array([tuple(key) in last for key in contacts.keys[patch].tolist()])
        along = along + (KEPT_BONUS * np.ptp(along, axis=0).max()) * kept[:, None]
    corners: Indices = np.unique(np.append(patch[np.argmax(along, axis=0)], deepest))
    return corners
