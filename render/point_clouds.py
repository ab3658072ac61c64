"""Whitewater as binary PLY files of points, written and read with numpy alone.

Layout (docs/guide/formats.md): binary little endian; a comment with the number of particles that had no room; one
element `vertex` with float32 `x y z vx vy vz radius lifetime` and uchar `kind`. No particles is legal: a frame without
whitewater.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from render.errors import InvalidFileError

KINDS = ("spray", "foam", "bubbles")
"""Names of the values of `kind`, from 0."""

_ROW = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "vx", "vy", "vz", "radius", "lifetime")), ("kind", "u1")])
_COMMENT = "comment not_made {not_made}\n"
_HEADER = (
    f"ply\nformat binary_little_endian 1.0\n{_COMMENT}element vertex {{count}}\n"
    + "".join(f"property {'uchar' if _ROW[name].kind == 'u' else 'float'} {name}\n" for name in _ROW.names or ())
    + "end_header\n"
)
_PATTERN = re.compile(
    re.escape(_HEADER)
    .replace(re.escape(_COMMENT), f"(?:{re.escape(_COMMENT)})?")
    .replace(re.escape("{count}"), r"(?P<count>0|[1-9]\d{0,9})")
    .replace(re.escape("{not_made}"), r"(?P<not_made>0|[1-9]\d{0,18})")
    .encode("ascii")
)
"""Files of earlier versions lack the comment."""
_LONGEST_HEADER = len(_HEADER) + 32


@dataclass(frozen=True)
class PointCloud:
    """Points in world axes.

    Attributes:
        position: [m], (n, 3), float32.
        velocity: [m/s], (n, 3), float32.
        radius: [m], (n,), float32.
        lifetime: what is left of it [s], (n,), float32.
        kind: index into `KINDS`, (n,), uint8.
        not_made: particles that the frame should have got, and had no room for.
    """

    position: NDArray[np.float32]
    velocity: NDArray[np.float32]
    radius: NDArray[np.float32]
    lifetime: NDArray[np.float32]
    kind: NDArray[np.uint8]
    not_made: int = 0


@dataclass(frozen=True)
class PointCounts:
    """The header of a cloud.

    Attributes:
        points: how many there are.
        not_made: how many had no room; None in files of earlier versions, which do not tell it.
    """

    points: int
    not_made: int | None


def write_point_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud; the same arrays give the same bytes.

    Raises:
        ValueError: the shapes do not fit together.
    """
    count = len(cloud.position)
    shapes = {name: getattr(cloud, name).shape for name in ("position", "velocity", "radius", "lifetime", "kind")}
    expected = {"position": (count, 3), "velocity": (count, 3)}
    if any(shape != expected.get(name, (count,)) for name, shape in shapes.items()):
        raise ValueError(f"a cloud needs a row of each for every point, got {shapes}")
    rows = np.empty(count, _ROW)
    for axis, name in enumerate("xyz"):
        rows[name], rows[f"v{name}"] = cloud.position[:, axis], cloud.velocity[:, axis]
    rows["radius"], rows["lifetime"], rows["kind"] = cloud.radius, cloud.lifetime, cloud.kind
    with path.open("wb") as file:
        file.write(_HEADER.format(count=count, not_made=cloud.not_made).encode("ascii"))
        file.write(rows.tobytes())


def read_point_cloud(path: Path) -> PointCloud:
    """Read a cloud that `write_point_cloud` wrote.

    Raises:
        InvalidFileError: it is not of this layout, or its size is not the one that its header promises.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    header = _header(path, content)
    if header["not_made"] is None:
        raise InvalidFileError(path, "does not tell what had no room, being of an earlier version; make it anew")
    count = int(header["count"])
    size = header.end() + count * _ROW.itemsize
    if len(content) != size:
        raise InvalidFileError(path, f"{len(content)} bytes, but its header promises {size}")
    rows = np.frombuffer(content, _ROW, count, header.end())
    return PointCloud(
        position=np.stack([rows[name] for name in ("x", "y", "z")], axis=1).astype(np.float32),
        velocity=np.stack([rows[name] for name in ("vx", "vy", "vz")], axis=1).astype(np.float32),
        radius=rows["radius"].astype(np.float32),
        lifetime=rows["lifetime"].astype(np.float32),
        kind=rows["kind"].copy(),
        not_made=int(header["not_made"]),
    )


def read_point_counts(path: Path) -> PointCounts:
    """Read the header of a cloud alone, be it of an earlier version.

    Raises:
        InvalidFileError: it is not of this layout.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        header = _header(path, file.read(_LONGEST_HEADER))
    not_made = header["not_made"]
    return PointCounts(int(header["count"]), None if not_made is None else int(not_made))


def validate_point_cloud(path: Path) -> None:
    """Decode a cloud fully: its size is as promised, every number finite, every radius positive, every kind known.

    Raises:
        InvalidFileError: it is not.
        OSError: it cannot be read.
    """
    cloud = read_point_cloud(path)
    for name in ("position", "velocity", "radius", "lifetime"):
        values = getattr(cloud, name)
        if not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            raise InvalidFileError(path, f"{name} of point {row} is not finite: {values[row].tolist()}")
    if (cloud.radius <= 0.0).any():
        row = int(np.flatnonzero(cloud.radius <= 0.0)[0])
        raise InvalidFileError(path, f"radius of point {row} is not positive: {cloud.radius[row]}")
    if (cloud.kind >= len(KINDS)).any():
        row = int(np.flatnonzero(cloud.kind >= len(KINDS))[0])
        raise InvalidFileError(path, f"kind of point {row} is {cloud.kind[row]}, of 0 to {len(KINDS) - 1}")


def _header(path: Path, content: bytes) -> re.Match[bytes]:
    header = _PATTERN.match(content)
    if header is None:
        raise InvalidFileError(path, "is not a point cloud of the expected layout (docs/guide/formats.md)")
    return header
