"""How supports share what they carry: forces at the contacts of a rigid body are not determined by how it moves.

A body on more contacts than hold it moves in the same way under many shares, of which a solver of contacts finds any:
all weight of a wall may be on the corners of two bricks. Of all shares that add up to the same force and moment, pull
nowhere and rub no more than friction allows, an elastic body takes the one of least energy (Menabrea 1858; Castigliano
1879).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from sim.rigid.contacts import Array, Indices

EXACT = 1.0e3  # weight of a kept force or moment beside energies, which are 1 at most
EVEN = 1.0e-4  # weight of each share: who stands on contacts of which any would do loads them alike
MOST_TURNS = 100  # of the search for shares, per share: it takes two or three
SOFTEST = 1.0e-12  # of the largest eigenvalue: what is less is rounding


class Supports(NamedTuple):
    """Forces that may carry a body that is glued of pieces, in the body's axes: four a contact, of full friction.

    Sums of them, none of which pulls, are the pyramid of what a contact may do.
    """

    piece: Indices  # which of its pieces each pushes, (k,)
    force: Array  # what each is the multiple of [-], (k, 3)
    moment: Array  # and its moment about the piece's centre [m], (k, 3)
    arm: Array  # from the body's centre of mass to its point [m], (k, 3)
    other: Indices  # number of what it touches: each keeps its own force and moment, (k,)
    carried: Array  # how much of it there is by the solver of contacts [N], (k,)


def friction_pyramid(normal: Array, force: Array, friction: Array) -> tuple[Array, Array]:
    """Edges of a pyramid about normals, (k, 3), that has given forces [N], (k, 3), inside: (4, k, 3), and their shares.

    Its edges across are along the friction that there is, so that all of it has room.
    """
    pressed = np.einsum("ki,ki->k", force, normal)
    rubbing = force - pressed[:, None] * normal
    size = np.sqrt(np.square(rubbing).sum(axis=1))
    least = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    along = np.where(size[:, None] > 0.0, rubbing, np.cross(normal, least))
    along = along / np.sqrt(np.square(along).sum(axis=1))[:, None]
    across = np.cross(normal, along)
    edges = np.stack([normal + sign * friction[:, None] * way for way in (along, across) for sign in (1.0, -1.0)])
    lean = np.divide(size, friction, out=np.zeros_like(size), where=friction > 0.0)
    shares = np.stack([0.5 * (pressed + lean), 0.5 * (pressed - lean), np.zeros_like(lean), np.zeros_like(lean)])
    return edges, np.maximum(shares, 0.0)


def least_shares(supports: Supports, curvature: Array, slope: Array, size: float) -> Array:
    """What each support carries if the body has the least energy [N], (k,).

    Args:
        supports: they.
        curvature: second derivatives of the energy by what they carry, (k, k).
        slope: its derivatives where they carry nothing, (k,).
        size: a length of the body, by which moments are divided [m].

    Raises:
        RuntimeError: the search does not end.
    """
    total = float(supports.carried.sum())
    values, ways = np.linalg.eigh(curvature)
    if total <= 0.0 or values[-1] <= 0.0:
        return supports.carried
    kept = values > SOFTEST * values[-1]
    roots, scale = np.sqrt(values[kept] / values[-1]), total * values[-1]
    rows = [roots[:, None] * ways[:, kept].T, EVEN * np.eye(len(slope))]
    wanted = [-(ways[:, kept].T @ slope) / (roots * scale), np.zeros(len(slope))]
    wrench = np.concatenate([supports.force, np.cross(supports.arm, supports.force) / size], axis=1)
    for other in np.unique(supports.other):
        own = EXACT * (wrench * (supports.other == other)[:, None]).T
        rows.append(own)
        wanted.append(own @ supports.carried / total)
    found, _ = nnls(np.concatenate(rows), np.concatenate(wanted), maxiter=MOST_TURNS * len(slope))
    shares: Array = total * found
    return shares
