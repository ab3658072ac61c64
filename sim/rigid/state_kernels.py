"""What a step does to each body by itself: where it is, how impulses move it, and how it flies on."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.array_types import Eases, Numbers, Rows, Vector3, Velocities, Whole

Vector4 = ti.types.vector(4, ti.f64)
Matrix3 = ti.types.matrix(3, 3, ti.f64)
Matrices = ti.types.ndarray(dtype=Matrix3, ndim=1)

SEQUENCE = ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5))
"""Principal axes and shares of the step; the same forwards and backwards, hence second order and reversible."""


@bundle
class Moving(NamedTuple):
    """The bodies that move, (n,): fields of `states.MovingBodies`, which are changed in place."""

    position: Rows
    orientation: Rows
    velocity: Rows
    angular_velocity: Rows
    inverse_mass: Numbers
    tensor: Matrices  # of inertia, in their own axes [kg m²]
    inverse_tensor: Matrices  # [1/(kg m²)]
    principal_moments: Rows
    principal_orientation: Rows


@ti.func
def vector_in(rows: ti.template(), row: ti.i32) -> Vector3:
    """Three numbers."""
    return Vector3(rows[row, 0], rows[row, 1], rows[row, 2])


@ti.func
def quaternion_in(rows: ti.template(), row: ti.i32) -> Vector4:
    """Four numbers."""
    return Vector4(rows[row, 0], rows[row, 1], rows[row, 2], rows[row, 3])


@ti.func
def quaternion_product(p: Vector4, q: Vector4) -> Vector4:
    """Rotate by q, then by p."""
    return Vector4(
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@ti.func
def matrix_of(q: Vector4) -> Matrix3:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return Matrix3(
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


@ti.func
def turned_freely(q: Vector4, moments: Vector3, spin: Vector3, dt: ti.f64) -> Vector4:
    """The orientation of principal axes after dt [s] without torque, as `states.turned_freely`; not normalized."""
    in_body, turned = matrix_of(q).transpose() @ spin, q
    for axis, share in ti.static(SEQUENCE):
        angle = share * dt * in_body[axis] / moments[axis]
        c, s = ti.cos(0.5 * angle), ti.sin(0.5 * angle)
        turn = Vector4(c, 0.0, 0.0, 0.0)
        turn[1 + axis] = s
        turned = quaternion_product(turned, turn)
        cosine, sine = c * c - s * s, 2.0 * c * s
        j, k = ti.static((axis + 1) % 3, (axis + 2) % 3)
        # Seen from the turned body, its spin turns backwards.
        in_body[j], in_body[k] = cosine * in_body[j] + sine * in_body[k], cosine * in_body[k] - sine * in_body[j]
    return turned


@kernel_of_host_arrays
def describe(moving: Moving, is_free: Whole, pose: Rows, ease: Eases):
    """Poses, row by row, and how easily impulses move bodies, where they are free; of the first of each.

    Args:
        pose: out: position and rotation matrix, (n or more, 12).
        ease: out: inverse mass [1/kg] and inertia xx, xy, xz, yy, yz, zz in world axes [1/(kg m²)], (n or more,).
    """
    for i in range(is_free.shape[0]):
        turned = matrix_of(quaternion_in(moving.orientation, i))
        inverse = turned @ moving.inverse_tensor[i] @ turned.transpose()
        for row in ti.static(range(3)):
            pose[i, row] = moving.position[i, row]
            for column in ti.static(range(3)):
                pose[i, 3 + 3 * row + column] = turned[row, column]
        ease[i] = ti.Vector.zero(ti.f64, 7)
        if is_free[i] == 1:
            ease[i] = ti.Vector(
                [moving.inverse_mass[i], inverse[0, 0], inverse[0, 1], inverse[0, 2],
                 inverse[1, 1], inverse[1, 2], inverse[2, 2]]
            )  # fmt: skip


@kernel_of_host_arrays
def fly_on(
    moving: Moving, dt: ti.f64, fall: Rows, extra: Velocities, is_active: Whole, is_touched: Whole, is_held: Whole
):
    """Move and turn active bodies for dt [s].

    A body in free flight moves by the mean of its velocities, which is exact; one that is touched by the new one. Its
    spin is carried over as it is, and turns with what turns the body extra where that is held by what cannot move,
    which takes any: that keeps the energy. Free turning is that of `states.turned_freely`.

    Args:
        fall: half of what gravity adds to velocities in the step [m/s], (1, 3).
        extra: velocities that only change poses, (n or more,).
    """
    for i in range(is_active.shape[0]):
        if is_active[i] == 1:
            velocity = vector_in(moving.velocity, i)
            if is_touched[i] == 0:
                velocity -= vector_in(fall, 0)
            q = quaternion_in(moving.orientation, i)
            turned = matrix_of(q)
            spin = turned @ (moving.tensor[i] @ (turned.transpose() @ vector_in(moving.angular_velocity, i)))
            rate = Vector3(extra[i][3], extra[i][4], extra[i][5])
            half = 0.5 * dt * rate.norm()
            if half > 0.0:
                turn = Vector4(ti.cos(half), 0.0, 0.0, 0.0)
                for axis in ti.static(range(3)):
                    turn[1 + axis] = 0.5 * dt * ti.sin(half) / half * rate[axis]
                q = quaternion_product(turn, q)
                q /= q.norm()
                if is_held[i] == 1:
                    spin = matrix_of(turn) @ spin
            principal = quaternion_in(moving.principal_orientation, i)
            conjugate = Vector4(principal[0], -principal[1], -principal[2], -principal[3])
            moments = vector_in(moving.principal_moments, i)
            q = quaternion_product(turned_freely(quaternion_product(q, principal), moments, spin, dt), conjugate)
            q /= q.norm()
            turned = matrix_of(q)
            rate = turned @ (moving.inverse_tensor[i] @ (turned.transpose() @ spin))
            for axis in ti.static(range(3)):
                moving.position[i, axis] += dt * (velocity[axis] + extra[i][axis])
                moving.angular_velocity[i, axis] = rate[axis]
            for component in ti.static(range(4)):
                moving.orientation[i, component] = q[component]
