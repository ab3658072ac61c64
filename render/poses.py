"""Poses of a frame's rigid bodies, as the JSON that `blender_scripts/poses.py` reads; docs/guide/formats.md."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

POSES_VERSION = 1


@dataclass(frozen=True)
class Placement:
    """Place of a body's mesh: its origin [m], and unit quaternion w, x, y, z."""

    position: Sequence[float]
    orientation: Sequence[float]


def the_short_way(quaternions: ArrayLike) -> NDArray[np.float64]:
    """The same turns, (n, 4), each by the sign that is nearer to the one before: nothing turns the long way round."""
    rows = np.asarray(quaternions, np.float64).reshape(-1, 4)
    flips = np.where(np.einsum("ij,ij->i", rows[1:], rows[:-1]) < 0.0, -1.0, 1.0)
    signed: NDArray[np.float64] = rows * np.cumprod([1.0, *flips])[:, None]
    return signed


def write_poses(path: Path, frame: int, bodies: Mapping[str, Mapping[str, NDArray[np.generic]]]) -> None:
    """Write the poses of one frame; the same poses give the same bytes. A number that is not finite raises ValueError.

    Of each body `position` (3,) of its mesh's origin [m], `orientation` (4,) as a unit quaternion w, x, y, z,
    `velocity` (3,) of that origin [m/s], `angular_velocity` (3,) about the world's axes [rad/s].
    """
    document = {
        "version": POSES_VERSION,
        "frame": frame,
        "bodies": {
            name: {key: np.asarray(arrays[key], dtype=np.float64).tolist() for key in _KEYS}
            for name, arrays in bodies.items()
        },
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


_KEYS = ("position", "orientation", "velocity", "angular_velocity")
