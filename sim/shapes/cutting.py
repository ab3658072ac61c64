"""Shapes cut into pieces: Voronoi cells of random points, or the parts of a compound; and the faces between them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Voronoi

from sim.shapes.assembly import BODY_PART, Assembly, manifold_of, mesh_of
from sim.shapes.distance_grids import THIN_SHARE, grid_spacing, thin_wall, wall_thickness
from sim.shapes.mesh_solid import ConvexSolid, MeshSolid
from sim.shapes.parameters import CompoundShape, MeshShape, PieceShape, Shape
from sim.shapes.placement import PlacedSolid, build_rest_shape
from sim.shapes.solid import RestShape, ShapeError, TriangleMesh

INSIDE_PART = "inside"
"""The part of a piece that its whole's surface did not have."""

CANDIDATES = 10  # points of which the farthest from all others is taken
MOST_DRAWS = 200_000  # of points, until one is inside of a shape
SAME_PLANE = 1.0e-6  # by how much planes of two faces that touch may differ, in sizes of the body
LEAST_AREA = 1.0e-9  # of a face between two pieces, in squared sizes of the body

MOST_CORNERS = 120  # of the hull of a piece
PIECE_CELLS = 32  # cells of a grid of distances along the longest edge of a piece, as cloth and smoke meet it

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TouchingFace:
    """Where two pieces touch: a plane region, in the frame of the whole."""

    first: int  # numbers of the pieces, from 0
    second: int
    normal: Array  # out of the first, (3,)
    triangles: Array  # corners [m], (t, 3, 3)


@dataclass(frozen=True, eq=False)
class Cut:
    """The pieces of a shape, in its frame, and the faces between them."""

    pieces: tuple[RestShape, ...]
    faces: tuple[TouchingFace, ...]
    whole: RestShape

    @cached_property
    def wall(self) -> float:
        """How thick the walls of the whole are [m]; see `distance_grids.wall_thickness`."""
        return wall_thickness(self.whole, THIN_SHARE)


def wall_and_cell(piece: PieceShape | None, solid: PlacedSolid) -> tuple[float, float]:
    """Thickness of a body's walls, and edge of the cells of the grid by which cloth and smoke meet it [m]; unturned.

    What is cut out of a whole is as thick as that: its own edges, however sharp, count as thin walls of others. The
    parts of a compound have walls of their own.
    """
    if piece is None:
        wall = thin_wall(solid)
        return wall, grid_spacing(solid, wall)
    wall = solid.scale * (wall_thickness(solid.shape, THIN_SHARE) if piece.pieces is None else cut_of(piece).wall)
    return wall, grid_spacing(solid, min(wall, float(np.ptp(solid.bounds, axis=0).min())), PIECE_CELLS)


def build_piece(shape: PieceShape) -> RestShape:
    """One of the pieces of a shape. Raises ShapeError where it cannot be cut."""
    pieces = cut_of(shape).pieces
    if shape.number > len(pieces):
        raise ShapeError(f"shape.number: there are {len(pieces)} pieces, got {shape.number}")
    return pieces[shape.number - 1]


def cut_of(shape: PieceShape) -> Cut:
    """All pieces of the shape that one is of."""
    return _cut(shape.of, shape.pieces, shape.seed, tuple(_states_of_files(shape.of)))


def united(pieces: Sequence[RestShape]) -> MeshSolid:
    """The solid that some pieces of one cut fill together: no surface is left where they touch.

    Each is made larger by a millionth about its middle, so that rounding leaves no gaps between them.
    """
    import manifold3d

    manifolds = []
    for number, piece in enumerate(pieces):
        mesh = piece.surface_mesh(None)
        middle = mesh.vertices.mean(axis=0)
        larger = middle + (1.0 + SAME_PLANE) * (mesh.vertices - middle)
        manifolds.append(manifold_of(TriangleMesh(larger, mesh.faces), f"piece {number + 1}"))
    union = manifold3d.Manifold.batch_boolean(manifolds, manifold3d.OpType.Add)
    parts = {manifold.original_id(): 0 for manifold in manifolds}
    return Assembly(mesh_of(union, parts, (BODY_PART,)))


def _states_of_files(shape: Shape) -> Iterator[tuple[int, int]]:
    """Sizes and times of the files of a shape, which may change while a program runs."""
    if isinstance(shape, MeshShape) and Path(shape.file).is_file():
        status = Path(shape.file).stat()
        yield status.st_size, status.st_mtime_ns
    for part in shape.part if isinstance(shape, CompoundShape) else ():
        yield from _states_of_files(part.shape)


@lru_cache(maxsize=8)
def _cut(of: Shape, count: int | None, seed: int, _files: tuple[tuple[int, int], ...]) -> Cut:
    if count is not None:
        return _voronoi_cut(build_rest_shape(of), count, seed)
    if not isinstance(of, CompoundShape):
        raise ShapeError("shape.pieces: is missing; only a compound has pieces without it, its parts")
    pieces = []
    for part in of.part:
        alone = part.model_copy(update={"name": None})
        pieces.append(build_rest_shape(CompoundShape(type="compound", part=(alone,))))
    meshes = [_with_inside(piece.surface_mesh(None)) for piece in pieces]
    size = float(np.max(np.ptp(np.concatenate([mesh.vertices for mesh in meshes]), axis=0)))
    return Cut(tuple(pieces), tuple(_touching(meshes, size)), build_rest_shape(of))


def _with_inside(mesh: TriangleMesh) -> TriangleMesh:
    """A mesh all of whose faces may be inside of the whole."""
    return TriangleMesh(mesh.vertices, mesh.faces, np.ones(len(mesh.faces), np.int32), (BODY_PART, INSIDE_PART))


def _voronoi_cut(whole: RestShape, count: int, seed: int) -> Cut:
    """The Voronoi cells of points in a shape, which they cut; each is convex, so that hulls of pieces never overlap."""
    import manifold3d

    mesh = whole.surface_mesh(None)
    solid = manifold_of(mesh, "shape")
    size = float(np.max(np.ptp(mesh.vertices, axis=0)))
    sites = _points_inside(whole, mesh.bounds, count, seed)
    pieces: list[RestShape] = []
    meshes = []
    for number, corners in enumerate(_cells(sites, mesh.bounds)):
        cell = manifold3d.Manifold.hull_points(corners).as_original()
        found = solid ^ cell
        if found.is_empty() or found.volume() <= 0.0:
            raise ShapeError(f"breaks.pieces: piece {number + 1} of {count} has no volume; give fewer, or another seed")
        parts = {solid.original_id(): 0, cell.original_id(): 1}
        surface = mesh_of(found, parts, (BODY_PART, INSIDE_PART))
        alone = len(found.decompose())
        warnings: tuple[str, ...] = ()
        if alone > 1:
            remedy = "which move as one; give more pieces, or another seed"
            warnings = (f"piece {number + 1} of {count} is in {alone} parts, {remedy}",)
        pieces.append(Assembly(surface, warnings=warnings, solids=(hull_of(surface.vertices),)))
        meshes.append(surface)
    return Cut(tuple(pieces), tuple(_touching(meshes, size)), whole)


def hull_of(points: Array) -> PlacedSolid:
    """The convex hull of some points; of round ones that of those that are farthest in some directions."""
    hull = ConvexHull(points)
    if len(hull.vertices) > MOST_CORNERS:
        # Evenly over a sphere (Gonzalez 2010, "Measurement of areas on a sphere using Fibonacci lattices").
        height = (2.0 * np.arange(MOST_CORNERS) + 1.0) / MOST_CORNERS - 1.0
        angle, across = np.arange(MOST_CORNERS) * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(1.0 - height * height)
        ways = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
        points = points[np.unique(np.argmax(points @ ways.T, axis=0))]
        hull = ConvexHull(points)
    used, faces = np.unique(hull.simplices, return_inverse=True)
    vertices, faces = points[used], faces.reshape(hull.simplices.shape).astype(np.int32)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    turned = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces[turned] = faces[turned][:, ::-1]
    return PlacedSolid(ConvexSolid(TriangleMesh(vertices, faces)), 1.0, np.eye(3), np.zeros(3))


def _points_inside(whole: RestShape, bounds: Array, count: int, seed: int) -> Array:
    """Random points in a shape [m], (count, 3), far from each other (best candidates; Mitchell 1991)."""
    stream, drawn, inside = np.random.PCG64(seed), 0, np.zeros((0, 3))
    sites = np.zeros((0, 3))
    while len(sites) < count:
        while len(inside) < CANDIDATES:
            if drawn >= MOST_DRAWS * CANDIDATES:
                raise ShapeError("shape: is too thin for points inside of it; make it thicker")
            chances = (stream.random_raw(3 * 1024) >> np.uint64(11)).reshape(-1, 3) * 2.0**-53
            points = bounds[0] + chances * (bounds[1] - bounds[0])
            inside = np.concatenate([inside, points[whole.signed_distance(points) < 0.0]])
            drawn += len(points)
        candidates, inside = inside[:CANDIDATES], inside[CANDIDATES:]
        away = np.square(candidates[:, None] - sites).sum(axis=2).min(axis=1, initial=np.inf)
        sites = np.concatenate([sites, candidates[np.argmax(away)][None]])
    return sites


def _cells(sites: Array, bounds: Array) -> Iterator[Array]:
    """Corners of the Voronoi cell of each point; points far outside close all of them beyond the bounds."""
    centre, reach = bounds.mean(axis=0), 10.0 * float(np.linalg.norm(bounds[1] - bounds[0]))
    away = np.concatenate([np.eye(3), -np.eye(3)]) * reach
    diagram = Voronoi(np.concatenate([sites, centre + away]))
    for number in range(len(sites)):
        yield diagram.vertices[diagram.regions[diagram.point_region[number]]]


def _touching(meshes: Sequence[TriangleMesh], size: float) -> Iterator[TouchingFace]:
    """Faces that pieces share: where faces inside of the whole lie on each other."""
    import manifold3d

    planes = [_inner_planes(mesh, size) for mesh in meshes]
    low, high = (np.array([getattr(mesh.vertices, edge)(axis=0) for mesh in meshes]) for edge in ("min", "max"))
    for first, second in combinations(range(len(meshes)), 2):
        if np.any(low[first] > high[second] + SAME_PLANE * size) or np.any(
            low[second] > high[first] + SAME_PLANE * size
        ):
            continue
        one, two = planes[first], planes[second]
        same = np.abs(one.rows[:, None] + two.rows).max(axis=2) <= SAME_PLANE
        for row, other in np.argwhere(same):
            normal = one.rows[row, :3]
            along = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
            axes = np.stack([along / np.linalg.norm(along), np.cross(normal, along) / np.linalg.norm(along)])
            origin = one.triangles[row][0, 0]
            sections = [
                manifold3d.CrossSection(list((triangles - origin) @ axes.T), manifold3d.FillRule.NonZero)
                for triangles in (one.triangles[row], two.triangles[other])
            ]
            common = sections[0] ^ sections[1]
            if common.area() <= LEAST_AREA * size * size:
                continue
            polygons = common.to_polygons()
            flat = np.concatenate(polygons)[manifold3d.triangulate(polygons)]
            yield TouchingFace(first, second, normal, origin + flat @ axes)


@dataclass(frozen=True, eq=False)
class _Planes:
    rows: Array  # normal, and offset in sizes of the body, of each plane, (p, 4)
    triangles: tuple[Array, ...]  # corners of the triangles in each [m], (t, 3, 3)


def _inner_planes(mesh: TriangleMesh, size: float) -> _Planes:
    """The planes of the inner faces of a piece."""
    assert mesh.part is not None, "the pieces of a cut have parts"
    corners = mesh.corners[mesh.part == 1]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(areas, axis=1)
    real = area > 1.0e-12 * size * size
    corners, normals = corners[real], areas[real] / area[real, None]
    rows = np.concatenate([normals, np.einsum("ij,ij->i", normals, corners[:, 0])[:, None] / size], axis=1)
    # The largest triangle of a plane tells its normal best.
    kept: list[Array] = []
    of_plane: list[list[int]] = []
    for number in np.argsort(-area[real], kind="stable"):
        differ = np.abs(np.array(kept).reshape(-1, 4) - rows[number]).max(axis=1)
        if kept and differ.min() <= SAME_PLANE * 10.0:
            of_plane[int(np.argmin(differ))].append(int(number))
        else:
            kept.append(rows[number])
            of_plane.append([int(number)])
    return _Planes(np.array(kept).reshape(-1, 4), tuple(corners[each] for each in of_plane))
