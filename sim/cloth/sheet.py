"""The sheet of a cloth at rest: its nodes, triangles and the share of its area that each node carries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import RectangleSheet
from sim.shapes.mesh_file import read_upright_triangles
from sim.shapes.mesh_solid import drop_collapsed_and_repeated_faces, merge_vertices
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import ShapeError

Vectors = NDArray[np.float64]
Indices = NDArray[np.int32]
Where = Callable[[NDArray[np.integer]], str]

SMALLEST_LENGTH, LARGEST_LENGTH = 1.0e-6, 1.0e6  # of what a sheet measures [m]; single precision ends well within

FLAT_TRIANGLE = 1.0e-4
"""A triangle less high than this share of its longest edge is a line: its angles are round-off in a file's float32."""

MERGED = 1.0e-5
"""A vertex farther than this from its node, in diagonals of the mesh, was not merged into it but dropped."""

DIRECTED = 0.2
"""A border has a direction if so much of its length runs along or across it, more than aslant; that of a disc: none."""


@dataclass(frozen=True)
class Grid:
    """How a rectangle is divided: node (i, j) has the number i + j * columns.

    Attributes:
        columns, rows: nodes along x and y.
        step_x, step_y: distances of neighbours [m].
    """

    columns: int
    rows: int
    step_x: float
    step_y: float


@dataclass(frozen=True, eq=False)
class RestSheet:
    """A sheet without loads, in its own axes.

    Attributes:
        vertices: [m], (n, 3) float64.
        triangles: corners, the same way round in the whole sheet, (k, 3) int32.
        node_area: share of the area of each node [m²], (n,); sums to the area of the sheet.
        uv: coordinates on the sheet at rest [m], (n, 2), from 0: along the sides of a rectangle; of a mesh as it is
            seen along the shortest side of its bounding box.
        warp: direction of the warp in each triangle, a unit vector, (k, 3); of a rectangle the x axis. See `warp_of`.
        node_of_vertex: node of each vertex of the mesh file, (m,) int32, -1 where no triangle uses it; of a rectangle
            the nodes themselves.
        grid: how it is divided if it is a rectangle.
        warnings: what was repaired, a sentence each.
    """

    vertices: Vectors
    triangles: Indices
    node_area: NDArray[np.float64]
    uv: NDArray[np.float64]
    warp: Vectors
    node_of_vertex: Indices
    grid: Grid | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Edges:
    """Edges of triangles.

    Attributes:
        nodes: their ends, the smaller number first, sorted, (e, 2) int32.
        of_side: edge of each side of each triangle, (3 k,); side s of triangle t, from corner s on, is 3 t + s.
    """

    nodes: Indices
    of_side: NDArray[np.int64]


def edges_of(triangles: NDArray[np.integer]) -> Edges:
    """Each edge once."""
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    nodes, of_side = np.unique(sides, axis=0, return_inverse=True)
    return Edges(nodes.astype(np.int32), of_side.reshape(-1))


def build_sheet(shape: RectangleSheet | MeshShape) -> RestSheet:
    """The sheet that a job describes.

    Raises:
        ShapeError: a mesh file is missing or unreadable, or its mesh is no sheet.
    """
    if isinstance(shape, RectangleSheet):
        return rectangle(shape)
    return sheet_of_triangles(*read_upright_triangles(shape), label=Path(shape.file).name)


def rectangle(shape: RectangleSheet) -> RestSheet:
    """A flat rectangle about the origin; the diagonals of its cells alternate, so that no direction is preferred."""
    columns, rows = shape.node_counts
    grid = Grid(columns, rows, shape.size[0] / (columns - 1), shape.size[1] / (rows - 1))
    j, i = (each.ravel() for each in np.mgrid[0:rows, 0:columns])
    share = np.stack([i / (columns - 1), j / (rows - 1)], axis=1)
    uv = share * shape.size
    vertices = np.concatenate([(share - 0.5) * shape.size, np.zeros((len(uv), 1))], axis=1)

    cell_j, cell_i = (each.ravel() for each in np.mgrid[0 : rows - 1, 0 : columns - 1])
    a = cell_i + columns * cell_j
    b, c, d = a + 1, a + columns + 1, a + columns
    rising = ((cell_i + cell_j) % 2 == 0)[:, None, None]
    triangles = np.where(
        rising,
        np.stack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)], axis=1),
        np.stack([np.stack([a, b, d], axis=1), np.stack([b, c, d], axis=1)], axis=1),
    ).reshape(-1, 3)

    share_x, share_y = np.ones(columns), np.ones(rows)
    share_x[[0, -1]] = share_y[[0, -1]] = 0.5
    node_area = grid.step_x * grid.step_y * share_x[i] * share_y[j]
    warp = np.tile([1.0, 0.0, 0.0], (len(triangles), 1))
    return RestSheet(
        vertices, triangles.astype(np.int32), node_area, uv, warp, np.arange(len(uv), dtype=np.int32), grid
    )


def sheet_of_triangles(vertices: Vectors, triangles: NDArray[np.integer], *, label: str) -> RestSheet:
    """A sheet from triangles as files hold them: split vertices are merged, and its sides made to agree.

    Args:
        vertices: [m], (n, 3).
        triangles: (k, 3).
        label: what errors call the mesh.

    Raises:
        ShapeError: no triangles; a triangle without area; an edge of three triangles or more; a sheet with one side.
    """
    import igl

    if not len(triangles):
        raise ShapeError(f'shape.file: "{label}" has no triangles; export it as a mesh')
    used, faces = np.unique(triangles, return_inverse=True)
    corners = np.asarray(vertices, dtype=np.float64)[used]
    if not np.isfinite(corners).all():
        number = int(used[~np.isfinite(corners).all(axis=1)][0])
        raise ShapeError(f'shape.file: vertex {number} of "{label}" is not finite; export it again')
    if not SMALLEST_LENGTH <= float(np.ptp(corners, axis=0).max()) <= LARGEST_LENGTH:
        raise ShapeError(
            f'shape.file: "{label}" is {np.ptp(corners, axis=0).max():.3g} m across, which must be between '
            f"{SMALLEST_LENGTH:g} m and {LARGEST_LENGTH:g} m; check its export, or give shape.size"
        )
    merged, faces = merge_vertices(corners, faces.reshape(-1, 3).astype(np.int64))
    # Once more: corners of triangles that are dropped may be corners of no other.
    merged, faces = merge_vertices(merged, _drop_second_sides(drop_collapsed_and_repeated_faces(faces)))
    warnings = []
    if len(merged) < len(vertices):
        warnings.append(f'"{label}": merged {len(vertices) - len(merged)} split or unused vertices')
    if len(faces) < len(triangles):
        warnings.append(f'"{label}": dropped {len(triangles) - len(faces)} collapsed or repeated triangles')

    def where(nodes: NDArray[np.integer]) -> str:
        return _place(corners, used, merged[nodes])

    _refuse_flat_triangles(merged, faces, where, label)
    _refuse_branching_edges(faces, where, label)
    oriented, _ = igl.bfs_orient(faces)
    turned = int(np.count_nonzero((oriented != faces).any(axis=1)))
    if turned:
        warnings.append(f'"{label}": turned {turned} of {len(faces)} triangles, so that the sides of the cloth agree')
    _refuse_one_sided(oriented, where, label)

    area = triangle_areas(merged, oriented)
    node_area = np.bincount(oriented.ravel(), weights=np.repeat(area / 3.0, 3), minlength=len(merged))
    extent = np.ptp(merged, axis=0)
    axes = np.sort(np.argsort(extent)[1:])
    uv = merged[:, axes] - merged[:, axes].min(axis=0)
    return RestSheet(
        merged,
        oriented.astype(np.int32),
        node_area,
        uv,
        warp_of(merged, oriented, axes),
        _nodes_of(vertices, merged),
        warnings=tuple(warnings),
    )


def warp_of(vertices: Vectors, triangles: NDArray[np.integer], axes: NDArray[np.integer]) -> Vectors:
    """Along the threads of a cloth that was cut straight: the direction in which most of its border runs, or at a right
    angle to it, whichever is nearer to the first axis; that axis itself if the border has no direction.

    In a curved sheet it is that direction projected onto each triangle, or at a right angle to the projection of the
    other one, whichever of the two is longer. As warp and weft are alike, they may change places.

    Args:
        vertices: [m], (n, 3).
        triangles: (k, 3).
        axes: numbers of the two axes along which the sheet is longest.
    """
    edges = edges_of(triangles)
    border = edges.nodes[np.bincount(edges.of_side) == 1]
    x, y = (vertices[border[:, 1]] - vertices[border[:, 0]])[:, axes].T
    along, length = x + 1j * y, np.hypot(x, y)
    turned = (along**4 / np.maximum(length, SMALLEST_LENGTH * 1e-6) ** 3).sum()  # the same for all four directions
    angle = 0.25 * np.angle(turned) if abs(turned) > DIRECTED * length.sum() else 0.0
    first, second = np.zeros((2, 3))
    first[axes], second[axes] = (np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    is_first = (np.abs(normal @ first) <= np.abs(normal @ second))[:, None]
    warp = np.where(is_first, first - (normal @ first)[:, None] * normal, np.cross(second, normal))
    unit: Vectors = warp / np.linalg.norm(warp, axis=1, keepdims=True)
    return unit


def _drop_second_sides(triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Without the second of two triangles that share their corners: models made for games have one for each side."""
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    return triangles[np.sort(first)]


def _nodes_of(vertices: Vectors, nodes: Vectors) -> Indices:
    """Which node each vertex has become; -1 for those that were dropped."""
    from scipy.spatial import cKDTree

    numbers = np.full(len(vertices), -1, dtype=np.int32)
    finite = np.flatnonzero(np.isfinite(vertices).all(axis=1))  # those that no triangle uses may be anything
    distance, nearest = cKDTree(nodes).query(vertices[finite])
    within = distance <= MERGED * np.linalg.norm(np.ptp(nodes, axis=0))
    numbers[finite[within]] = nearest[within]
    return numbers


def pieces_of(triangles: NDArray[np.integer]) -> NDArray[np.int32]:
    """Number of the connected piece that each node belongs to, up to the last that a triangle has, (n,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = int(triangles.max(initial=-1)) + 1
    a, b, c = triangles.T
    links = coo_array((np.ones(2 * len(a)), (np.concatenate([a, b]), np.concatenate([b, c]))), shape=(count, count))
    label: NDArray[np.int32] = connected_components(links, directed=False)[1] if count else np.zeros(0, dtype=np.int32)
    return label


def triangle_areas(vertices: Vectors, triangles: NDArray[np.integer]) -> NDArray[np.float64]:
    """Area of each triangle [m²], (k,)."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    areas: NDArray[np.float64] = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


def _place(corners: Vectors, numbers: NDArray[np.int64], nodes: Vectors) -> str:
    """The middle of some nodes [m], and the vertices of the file that they were, by their corners and numbers there."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(corners).query(nodes)
    middle = ", ".join(f"{coordinate:.4g}" for coordinate in nodes.mean(axis=0))
    *others, last = (str(number) for number in sorted(numbers[nearest]))
    return f"({middle}) m between vertices {', '.join(others)} and {last}, counted from 0"


def _refuse_flat_triangles(vertices: Vectors, triangles: NDArray[np.int64], where: Where, label: str) -> None:
    corners = vertices[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    flat = np.flatnonzero(2.0 * triangle_areas(vertices, triangles) <= FLAT_TRIANGLE * longest**2)
    if len(flat):
        raise ShapeError(
            f'shape.file: {len(flat)} triangles of "{label}" have no area, the first at '
            f"{where(triangles[flat[0]])}; remove them (Blender: Mesh > Clean Up > Degenerate Dissolve)"
        )


def _refuse_branching_edges(triangles: NDArray[np.int64], where: Where, label: str) -> None:
    edges = edges_of(triangles)
    branching = edges.nodes[np.bincount(edges.of_side) > 2]
    if len(branching):
        raise ShapeError(
            f'shape.file: {len(branching)} edges of "{label}" have three triangles or more, the first at '
            f"{where(branching[0])}; a cloth has two sides: split it there"
        )


def _refuse_one_sided(triangles: NDArray[np.integer], where: Where, label: str) -> None:
    """After neighbours were made to agree: one edge passed twice the same way makes a Moebius strip."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    passed, count = np.unique(edges, axis=0, return_counts=True)
    twice = passed[count > 1]
    if len(twice):
        raise ShapeError(
            f'shape.file: "{label}" has one side only, like a Moebius strip, seen at {where(twice[0])}; cut it open'
        )
