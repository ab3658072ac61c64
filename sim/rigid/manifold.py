"""A few contacts of a pair of bodies that hold it as all of them would."""

from __future__ import annotations

import numpy as np

from sim.rigid.contacts import Array, Contacts, Indices, Key, tangent_basis

SAME_PATCH = 0.9  # normals closer than this cosine (26°) belong to one patch of contact
MOST_PATCHES = 4  # patches of one pair that are kept, deepest first: more normals than three hold a body in any pose
KEPT_BONUS = 2.0e-3  # head start, in extents of the patch, of points of the last step: equal ones must not take turns

_ANGLES = 2.0 * np.pi * (np.arange(8) + 0.29) / 8.0
_DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Eight directions find every corner of a convex patch with an angle under 135°; the offset avoids symmetry axes."""


def reduce_manifold(contacts: Contacts, last: frozenset[Key], *, margin: float) -> Indices:
    """Rows of the contacts to keep: by patches of like normals, deepest first; ascending within a patch.

    Args:
        contacts: of one pair, one at least.
        last: keys of the last step's contacts, which are preferred among equals.
        margin: the largest gap that was looked for [m].
    """
    kept = []
    remaining = np.arange(len(contacts))
    for _ in range(MOST_PATCHES):
        deepest = remaining[np.argmin(contacts.gap[remaining])]
        normal = contacts.normal[deepest]
        alike = contacts.normal[remaining] @ normal >= SAME_PATCH
        kept.append(_corners(contacts, remaining[alike], deepest, normal, last, margin))
        remaining = remaining[~alike]
        if not len(remaining):
            break
    return np.concatenate(kept)


def _corners(
    contacts: Contacts, patch: Indices, deepest: np.int64, normal: Array, last: frozenset[Key], margin: float
) -> Indices:
    """The deepest point of a patch, and those that meet first when it is tilted in eight directions.

    The tilt is a margin across the patch: of a flat face the corners are kept, of a bumpy or a round one the bumps
    that it stands on. The outermost points alone, which may hang above, would let it sink from bump to bump.
    """
    if len(patch) <= 2:
        return patch
    along = (contacts.point[patch] @ tangent_basis(normal[None])[0].T) @ _DIRECTIONS
    extent = np.ptp(along, axis=0).max()
    if last:
        kept = np.array([tuple(key) in last for key in contacts.keys[patch].tolist()])
        along = along + (KEPT_BONUS * extent) * kept[:, None]
    reach = margin * along - extent * contacts.gap[patch, None]
    return np.unique(np.append(patch[np.argmax(reach, axis=0)], deepest))
