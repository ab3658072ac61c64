"""Rotation without torque, by a symmetric splitting that keeps the angular momentum to round-off."""

from __future__ import annotations

import numpy as np

from sim.core.motion import rotation
from sim.rigid.states import MovingBodies

_SEQUENCE = ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5))
"""Principal axes and shares of the step; the same forwards and backwards, hence second order and reversible."""

_COMPONENTS = ([1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0])
_SIGNS = np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])
"""q i, q j and q k: the components of q in another order, with signs."""


def rotate_freely(bodies: MovingBodies, dt: float) -> None:
    """Turn the free bodies by I domega/dt = -omega x (I omega) for dt [s].

    Strang splitting of the Euler equations into rotations about the principal axes (Dullweber, Leimkuhler & McLachlan
    1997, "Symplectic splitting methods for rigid body molecular dynamics"; McLachlan 1993). Every part is solved as a
    rotation, so that |L| is exact; as the method is symplectic, the energy oscillates by O((omega dt)²) without drift.
    The spin in world axes is carried over as it is; the angular velocity follows from it.
    """
    spin = bodies.angular_momentum()
    q = rotation.product(bodies.orientation, bodies.principal_orientation)
    in_body = np.einsum("nji,nj->in", rotation.matrices(q), spin)
    for axis, share in _SEQUENCE:
        angle = share * dt * in_body[axis] / bodies.principal_moments[:, axis]
        c, s = np.cos(0.5 * angle), np.sin(0.5 * angle)
        q = c[:, None] * q + s[:, None] * (_SIGNS[axis] * q[:, _COMPONENTS[axis]])
        # Seen from the turned body, its spin turns backwards.
        cosine, sine = c * c - s * s, 2.0 * c * s
        j, k = (axis + 1) % 3, (axis + 2) % 3
        in_body[j], in_body[k] = cosine * in_body[j] + sine * in_body[k], cosine * in_body[k] - sine * in_body[j]
    q = rotation.normalized(rotation.product(q, rotation.conjugate(bodies.principal_orientation)))
    bodies.orientation = np.where(bodies.is_free[:, None], q, bodies.orientation)
    bodies.set_angular_momentum(spin)
