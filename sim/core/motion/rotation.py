"""Rotations as unit quaternions w, x, y, z (Hamilton's product), many at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def _coefficients(forms: list[str]) -> Array:
    """Coefficients, (16, k), of bilinear forms in w, x, y, z such as "+ww-xx", for `_bilinear`."""
    table = np.zeros((4, 4, len(forms)))
    for column, form in enumerate(forms):
        for sign, first, second in zip(form[::3], form[1::3], form[2::3], strict=True):
            table["wxyz".index(first), "wxyz".index(second), column] += float(f"{sign}1")
    return table.reshape(16, len(forms))


_PRODUCT = _coefficients(["+ww-xx-yy-zz", "+wx+xw+yz-zy", "+wy-xz+yw+zx", "+wz+xy-yx+zw"])
_MATRIX = _coefficients(
    [
        *("+ww+xx-yy-zz", "+xy+xy-wz-wz", "+xz+xz+wy+wy"),
        *("+xy+xy+wz+wz", "+ww-xx+yy-zz", "+yz+yz-wx-wx"),
        *("+xz+xz-wy-wy", "+yz+yz+wx+wx", "+ww-xx-yy+zz"),
    ]
)


def _bilinear(p: Array, q: Array, coefficients: Array) -> Array:
    """Bilinear forms of quaternions, (..., k): for a few of them much faster than term by term."""
    pairs = p[..., :, None] * q[..., None, :]
    return np.einsum("...i,ik->...k", pairs.reshape(*pairs.shape[:-2], 16), coefficients)


def cross(a: Array, b: Array) -> Array:
    """Cross product along the last axis, (..., 3); numpy's own takes several times as long for a few vectors."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    result = np.empty(np.broadcast_shapes(a.shape, b.shape))
    result[..., 0] = a1 * b2 - a2 * b1
    result[..., 1] = a2 * b0 - a0 * b2
    result[..., 2] = a0 * b1 - a1 * b0
    return result


def product(p: Array, q: Array) -> Array:
    """Quaternion product p q: rotate by q, then by p; (..., 4)."""
    return _bilinear(p, q, _PRODUCT)


def conjugate(q: Array) -> Array:
    """The inverse rotation, (..., 4)."""
    return q * _CONJUGATE


def normalized(q: Array) -> Array:
    """Scaled to unit length, (..., 4)."""
    return q / np.sqrt(np.square(q).sum(axis=-1, keepdims=True))


def matrices(q: Array) -> Array:
    """Rotation matrices of unit quaternions (..., 4): (..., 3, 3)."""
    return _bilinear(q, q, _MATRIX).reshape(*q.shape[:-1], 3, 3)


def from_matrix(rotation: Array) -> Array:
    """Unit quaternion with w >= 0 of one rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)


def from_degrees(rotation_deg: ArrayLike) -> Array:
    """Unit quaternions of rotations about the world's x, then y, then z [degrees], (3,) or (n, 3)."""
    from scipy.spatial.transform import Rotation

    quaternion: Array = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_quat(
        canonical=True, scalar_first=True
    )
    return quaternion


def to_degrees(q: Array) -> Array:
    """Rotations about the world's x, then y, then z that make up unit quaternions (4,) or (n, 4) [degrees]."""
    from scipy.spatial.transform import Rotation

    # At 90 degrees about y only the sum of the other two counts: z is 0 then.
    found: Array = Rotation.from_quat(q, scalar_first=True).as_euler("xyz", degrees=True, suppress_warnings=True)
    return found


def exponential(vector: Array) -> Array:
    """Unit quaternions of rotation vectors [rad], (..., 3): (..., 4)."""
    half = 0.5 * np.sqrt(np.square(vector).sum(axis=-1, keepdims=True))
    # np.sinc(x) is sin(pi x) / (pi x), finite at 0.
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)


def logarithm(q: Array) -> Array:
    """Rotation vector [rad] of the shorter way, (..., 3), of unit quaternions (..., 4)."""
    shorter = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.sqrt(np.square(shorter[..., 1:]).sum(axis=-1, keepdims=True))
    half = np.arctan2(sine, shorter[..., :1])
    return 2.0 * shorter[..., 1:] / np.sinc(half / np.pi)


def rotated(q: Array, vector: Array) -> Array:
    """Vectors (..., 3) turned by unit quaternions (..., 4)."""
    axis = q[..., 1:]
    twice = 2.0 * cross(axis, vector)
    return vector + q[..., :1] * twice + cross(axis, twice)
