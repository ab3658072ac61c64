"""Snapshots: what rendering needs of a body at one frame, as host arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Attribute = int | float | str | tuple[float, ...]


@dataclass(frozen=True)
class Snapshot:
    """One body at one frame.

    Arrays by kind (SI units, world axes, all float32 unless noted):

    - fluid: `position` (n, 3) [m], `velocity` (n, 3) [m/s], `density` (n,) [kg/m³], `pressure` (n,)
      [Pa], `particle_id` (n,) int32; `dye` (n,) [-] of a fluid that has some. Attributes: `particle_radius` [m],
      `rest_density` [kg/m³]. Rows are sorted by `particle_id`.
    - soft: `position` (n, 3) [m], `velocity` (n, 3) [m/s], `particle_id` (n,) int32, ascending. Attributes: `radius`
      half the spacing of particles at rest [m], `material`.
    - smoke: `density` (nx, ny, nz) [-], `temperature` (nx, ny, nz) [K], `velocity` (nx, ny, nz, 3) [m/s],
      all at cell centres. Attributes: `origin` (3,) lower corner of the grid [m], `cell_size` [m],
      `ambient_temperature` [K].
    - embers: `position` (n, 3) [m], `velocity` (n, 3) [m/s], `temperature` (n,) [K], `diameter` (n,) [m], `particle_id`
      (n,) int32, ascending. Attribute: `radius` of the mean size [m].
    - rigid: `position` (3,) [m], `orientation` (4,) unit quaternion w, x, y, z, `velocity` (3,) [m/s],
      `angular_velocity` (3,) [rad/s]; all float64. The mesh is the body's own, in its rest pose.
    - cloth: `position` (n, 3) [m], `velocity` (n, 3) [m/s], and the same in every frame: `triangles` (k, 3) int32, and
      `uv` (n, 2) coordinates on the sheet at rest [m]. Attribute: `thickness` [m].
    """

    kind: str
    arrays: Mapping[str, NDArray[np.generic]]
    attributes: Mapping[str, Attribute]
    group: str | None = None  # name of the group that a rigid body is of, or its own

    def number(self, attribute: str) -> float:
        """A scalar attribute. Raises KeyError when there is none, TypeError when it is not a number."""
        value = self.attributes[attribute]
        if not isinstance(value, int | float):
            raise TypeError(f"{attribute} is not a number: {value!r}")
        return float(value)

    def vector(self, attribute: str) -> tuple[float, ...]:
        """A vector attribute. Raises KeyError when there is none, TypeError when it is not a vector."""
        value = self.attributes[attribute]
        if not isinstance(value, tuple):
            raise TypeError(f"{attribute} is not a vector: {value!r}")
        return value
