"""The geometry of Wavefront OBJ files: vertices as the file numbers them, and triangles.

Only `v` and `f` lines are read. A reader that also wants texture coordinates or materials has to split vertices at
seams, and sorts them by object: their numbers are then no longer those of the file, by which pins name them.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim.shapes.solid import Points


def read_obj(text: str) -> tuple[Points, NDArray[np.int64]]:
    """Vertices (n, 3) in the order of the file, and triangles (m, 3); polygons become fans about their first corner.

    Raises:
        ValueError: a line cannot be read; the message names it.
    """
    vertices: list[tuple[float, float, float]] = []
    triangles: list[tuple[int, int, int]] = []
    begun = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if line.endswith("\\"):  # it goes on in the next one
            begun += line[:-1] + " "
            continue
        (key, *values), begun = (begun + line).split() or [""], ""
        try:
            if key == "v":
                x, y, z = (float(value) for value in values[:3])
                vertices.append((x, y, z))
            elif key == "f":
                corners = [_vertex_number(value, len(vertices)) for value in values if not value.startswith("#")]
                triangles.extend((corners[0], after, last) for after, last in pairwise(corners[1:]))
        except (ValueError, IndexError) as error:
            raise ValueError(f'line {number}, "{line.strip()[:60]}": {error}') from error
    return (
        np.array(vertices, dtype=np.float64).reshape(-1, 3),
        np.array(triangles, dtype=np.int64).reshape(-1, 3),
    )


def _vertex_number(corner: str, count: int) -> int:
    """From 0, of the vertex in v, v/vt, v//vn or v/vt/vn; negative numbers count back from the latest of `count`."""
    number = int(corner.partition("/")[0])
    if number == 0 or number < -count:
        raise ValueError(f"a face names vertex {number}; {count} are there, numbered from 1")
    return number - 1 if number > 0 else count + number
