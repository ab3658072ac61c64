"""The geometry of Wavefront OBJ files: vertices as the file numbers them, and triangles.

Only `v`, `vt` and `f` lines are read. Texture coordinates belong to the corners of triangles: a reader that gives them
to vertices has to split these at seams, and their numbers are then no longer those of the file, by which pins name
them.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim.shapes.solid import Points

ROUND_OFF = 1.0e-2  # part of a polygon's area by which its triangles may overlap: files of few digits
LARGEST_TEXTURE = float(np.finfo(np.float32).max)  # beyond it coordinates are infinite in float32


def read_obj(text: str) -> tuple[Points, NDArray[np.int64], NDArray[np.float64] | None]:
    """Vertices (n, 3) in the order of the file, triangles (m, 3), and texture coordinates of their corners (m, 3, 2).

    Polygons become fans about their first corner. Coordinates are 0 where a corner names none that is there and can be
    used, and None for a file without any.

    Raises:
        ValueError: a `v` or `f` line cannot be read, or has a polygon that such a fan does not fill; named by line.
    """
    vertices: list[tuple[float, float, float]] = []
    triangles: list[tuple[int, int, int]] = []
    texture: list[tuple[float, float]] = [(0.0, 0.0)]  # numbered from 1, as in the file
    textured: list[tuple[int, int, int]] = []
    lines: list[int] = []  # of each triangle
    begun = ""
    for number, line in enumerate([*text.splitlines(), ""], start=1):  # the empty one ends what the last one began
        content = line.partition("#")[0].rstrip()  # comments do not go on in the next line
        if content.endswith("\\"):
            begun += content[:-1] + " "
            continue
        whole, begun = begun + content, ""
        key, *values = whole.split() or [""]
        try:
            if key == "v":
                x, y, z = (float(value) for value in values[:3])
                vertices.append((x, y, z))
            elif key == "vt":
                texture.append(_texture_place(values))
            elif key == "f":
                corners = [_vertex_number(value, len(vertices)) for value in values]
                if len(corners) < 3:
                    raise ValueError(f"a face needs three corners or more, got {len(corners)}")
                triangles.extend((corners[0], after, last) for after, last in pairwise(corners[1:]))
                places = [_texture_number(value, len(texture)) for value in values]
                textured.extend((places[0], after, last) for after, last in pairwise(places[1:]))
                lines.extend([number] * (len(corners) - 2))
        except ValueError as error:
            raise ValueError(f'line {number}, "{whole.strip()[:60]}": {error}') from error
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    _refuse_overlaps(points, faces, np.array(lines, dtype=np.int64))
    if len(texture) == 1:
        return points, faces, None
    return points, faces, np.array(texture)[np.array(textured, dtype=np.int64).reshape(-1, 3)]


def _refuse_overlaps(vertices: Points, triangles: NDArray[np.int64], lines: NDArray[np.int64]) -> None:
    """Refuse polygons, by the line of each triangle, (m,), whose fan has triangles that face the other way.

    Vertices that are not there, or not finite, are left to who knows the file.
    """
    known = (triangles < len(vertices)).all(axis=1)
    first, second, third = np.moveaxis(vertices[triangles[known]], 1, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        normal = np.cross(second - first, third - first)
        own, polygon = np.unique(lines[known], return_inverse=True)
        total = np.stack([np.bincount(polygon, normal[:, axis], len(own)) for axis in range(3)], axis=1)
        along = (normal * total[polygon]).sum(axis=1)
        opposes = along < -ROUND_OFF * np.square(total[polygon]).sum(axis=1)
    if opposes.any():
        raise ValueError(
            f"line {lines[known][opposes.argmax()]}: a concave polygon, which triangles about its first corner do not "
            "fill; divide polygons into triangles on export"
        )


def _vertex_number(corner: str, count: int) -> int:
    """From 0, of the vertex in v, v/vt, v//vn or v/vt/vn; negative numbers count back from the latest of `count`."""
    number = int(corner.partition("/")[0])
    if number == 0 or number < -count:
        raise ValueError(f"a face names vertex {number}; {count} are there, numbered from 1")
    return number - 1 if number > 0 else count + number


def _texture_place(values: list[str]) -> tuple[float, float]:
    """Texture coordinates in a `vt` line; 0 if they cannot be read or are not finite in the float32 of meshes."""
    try:
        u, v, *_ = (*(float(value) for value in values[:2]), 0.0)  # one alone is a place on a strip
    except ValueError:
        return 0.0, 0.0
    return (u, v) if abs(u) <= LARGEST_TEXTURE and abs(v) <= LARGEST_TEXTURE else (0.0, 0.0)


def _texture_number(corner: str, count: int) -> int:
    """From 1, of the texture coordinates in v/vt or v/vt/vn, of fewer than `count`; 0 where there are none."""
    _, _, rest = corner.partition("/")
    word = rest.partition("/")[0]
    number = int(word) if word else 0
    number = count + number if number < 0 else number
    return number if 0 < number < count else 0
