"""Drops, whitewater and embers as binary PLY files of points, by numpy alone; `blender_scripts.ply` has the layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from blender_scripts.ply import KINDS, OWN_COLUMNS, POINT_OF, drawn_radii, points_header, read_points, written_header
from render.errors import InvalidFileError, invalid_if_refused

__all__ = [
    "KINDS",
    "PointCloud",
    "drawn_radii",
    "read_point_cloud",
    "read_point_counts",
    "validate_point_cloud",
    "write_point_cloud",
]

_LONGEST_HEADER = max(len(written_header(own, count=0, not_made=0)) for own in OWN_COLUMNS) + 32


@dataclass(frozen=True)
class PointCloud:
    """Points in world axes.

    Attributes:
        position: [m], (n, 3), float32.
        velocity: [m/s], (n, 3), float32.
        radius: [m], (n,), float32.
        lifetime: what is left of it [s], (n,), float32; drops do not fade.
        kind: index into `KINDS`, (n,), uint8.
        not_made: particles that the frame should have got, and had no room for.
        dye: concentration [-], (n,), float32, of drops and grains of what has dye; else None.
        temperature: [K], (n,), float32, of embers; else None. A cloud has one of both at most.
    """

    position: NDArray[np.float32]
    velocity: NDArray[np.float32]
    radius: NDArray[np.float32]
    lifetime: NDArray[np.float32]
    kind: NDArray[np.uint8]
    not_made: int = 0
    dye: NDArray[np.float32] | None = None
    temperature: NDArray[np.float32] | None = None

    @property
    def own(self) -> str | None:
        """The column that this cloud has and others have not."""
        return next((name for name in OWN_COLUMNS if getattr(self, name) is not None), None)


@dataclass(frozen=True)
class PointCounts:
    """The numbers in the header of a cloud: points, and those that had no room (None in files of earlier versions)."""

    points: int
    not_made: int | None


def write_point_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud; the same arrays give the same bytes.

    Raises:
        ValueError: the shapes do not fit together.
    """
    count = len(cloud.position)
    names = ("position", "velocity", "radius", "lifetime", "kind", *(() if cloud.own is None else (cloud.own,)))
    shapes = {name: getattr(cloud, name).shape for name in names}
    expected = {"position": (count, 3), "velocity": (count, 3)}
    if any(shape != expected.get(name, (count,)) for name, shape in shapes.items()):
        raise ValueError(f"a cloud needs a row of each for every point, got {shapes}")
    rows = np.empty(count, POINT_OF[cloud.own])
    for axis, name in enumerate("xyz"):
        rows[name], rows[f"v{name}"] = cloud.position[:, axis], cloud.velocity[:, axis]
    rows["radius"], rows["lifetime"], rows["kind"] = cloud.radius, cloud.lifetime, cloud.kind
    if cloud.own is not None:
        rows[cloud.own] = getattr(cloud, cloud.own)
    with path.open("wb") as file:
        file.write(written_header(cloud.own, count=count, not_made=cloud.not_made))
        file.write(rows.tobytes())


def read_point_cloud(path: Path) -> PointCloud:
    """Read a cloud that `write_point_cloud` wrote.

    Raises:
        InvalidFileError: it is not of this layout, or its size is not the one that its header promises.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    with invalid_if_refused(path):
        header = points_header(content)
    if header["not_made"] is None:
        raise InvalidFileError(path, "does not tell what had no room, being of an earlier version; make it anew")
    with invalid_if_refused(path):
        rows = read_points(content)
    return PointCloud(
        position=np.stack([rows[name] for name in ("x", "y", "z")], axis=1).astype(np.float32),
        velocity=np.stack([rows[name] for name in ("vx", "vy", "vz")], axis=1).astype(np.float32),
        radius=rows["radius"].astype(np.float32),
        lifetime=rows["lifetime"].astype(np.float32),
        kind=rows["kind"].copy(),
        not_made=int(header["not_made"]),
        **{name: rows[name].astype(np.float32) for name in OWN_COLUMNS if name in (rows.dtype.names or ())},
    )


def read_point_counts(path: Path) -> PointCounts:
    """Read the header of a cloud alone, be it of an earlier version.

    Raises:
        InvalidFileError: it is not of this layout.
        OSError: it cannot be read.
    """
    with path.open("rb") as file, invalid_if_refused(path):
        header = points_header(file.read(_LONGEST_HEADER))
    not_made = header["not_made"]
    return PointCounts(int(header["count"]), None if not_made is None else int(not_made))


def validate_point_cloud(path: Path) -> None:
    """Decode a cloud fully: its size is as promised, every number finite, every radius positive, every kind known.

    Raises:
        InvalidFileError: it is not.
        OSError: it cannot be read.
    """
    cloud = read_point_cloud(path)
    for name in ("position", "velocity", "radius", "lifetime", *OWN_COLUMNS):
        values = getattr(cloud, name)
        if values is not None and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            raise InvalidFileError(path, f"{name} of point {row} is not finite: {values[row].tolist()}")
    if (cloud.radius <= 0.0).any():
        row = int(np.flatnonzero(cloud.radius <= 0.0)[0])
        raise InvalidFileError(path, f"radius of point {row} is not positive: {cloud.radius[row]}")
    if (cloud.kind >= len(KINDS)).any():
        row = int(np.flatnonzero(cloud.kind >= len(KINDS))[0])
        raise InvalidFileError(path, f"kind of point {row} is {cloud.kind[row]}, of 0 to {len(KINDS) - 1}")
