"""The inside of a triangle mesh, closed or not, by its generalized winding number, and the repairs that it needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.shapes.mass_properties import integrate_moments
from sim.shapes.sampling import stratified_points
from sim.shapes.solid import Points, RestShape, ShapeError, TriangleMesh, boundary_edges
from sim.shapes.tessellation import halve_long_edges, longest_edge

_DECIDED_WITHIN = 0.1  # of an integer a winding number is decided; beside a hemisphere it is off by 0.15 to 0.25
_LARGEST_UNDECIDED = 0.2  # largest fraction of the surface beside which the inside may be undecided
_WORTH_A_WARNING = 0.01  # undecided fraction of a mesh without holes from which on the user is told

_PROBES = 4096
_PROBE_OFFSET = 1.0e-4  # of probes from the surface, in bounding-box diagonals: above round-off, below any wall

Faces = NDArray[np.int64]
_MERGE_DISTANCE = 1.0e-6  # of vertices that are one, in bounding-box diagonals: what float32 can tell apart
_CAVITY_PROBES = 256  # about how many vertices of a closed patch are asked whether they lie inside of the rest


@dataclass(frozen=True, eq=False)
class MeshSolid(RestShape):
    """A solid bounded by a triangle mesh about its own origin.

    A point is inside where the generalized winding number of the mesh (Jacobson et al. 2013, evaluated as by Barill et
    al. 2018) exceeds 1/2: overlapping parts unite, and holes are spanned smoothly. Its distance is that to the nearest
    triangle, caps included, that is not buried in another part, exact to round-off but at holes with an uneven rim, and
    along seams of overlapping parts, where crossing triangles count with their buried ends.
    """

    mesh: TriangleMesh  # outward-oriented triangles, the caps last
    cap_count: int = 0  # how many of the last faces are caps
    warnings: tuple[str, ...] = ()  # what was repaired or assumed

    @cached_property
    def volume(self) -> float:
        """Volume [m³]: exact for closed (or capped) parts that do not overlap, else within about 0.5 %."""
        if self.encloses_simply:
            return self.mesh.signed_volume
        return integrate_moments(self).volume

    @cached_property
    def parts_overlap(self) -> bool:
        """Whether some of the surface is buried in the solid, as its parts overlap."""
        return bool(np.any(self.winding_beside_surface()[:, 1] > 0.5))

    @cached_property
    def encloses_simply(self) -> bool:
        """Whether surface integrals over the mesh are integrals over its inside."""
        return self.mesh.is_closed and not self.parts_overlap

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner [m], (2, 3)."""
        return self.mesh.bounds

    def support(self, directions: Points) -> NDArray[np.float64]:
        """Largest x·d over the mesh [m]."""
        return (self.mesh.vertices @ directions.T).max(axis=0)

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the nearest triangle [m], negative inside, (n,)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        if not len(points):
            return np.empty(0)
        # igl.signed_distance with the fast winding number scales the distance by 1 - 2|w|, which is none near holes.
        squared, _, _ = self._distance_tree.squared_distance(self.mesh.vertices, self._bounding_faces, points)
        return np.where(self.winding_number(points) > 0.5, -1.0, 1.0) * np.sqrt(squared)

    def winding_number(self, points: Points) -> NDArray[np.float64]:
        """Generalized winding number [-] of the mesh without its caps, (n,)."""
        return self._winding_tree.winding_number(np.ascontiguousarray(points, dtype=np.float64), 2.0)

    def winding_beside_surface(self) -> NDArray[np.float64]:
        """Winding number just inside and just outside of the mesh without its caps, (k, 2), evenly by area."""
        mesh = TriangleMesh(self.mesh.vertices, self.mesh.faces[: len(self.mesh.faces) - self.cap_count])
        points, face = stratified_points(mesh, _PROBES)
        step = self._probe_step(mesh.area_vectors[face])
        return np.stack([self.winding_number(points - step), self.winding_number(points + step)], axis=1)

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """The mesh with its caps; edges cut in two until none is longer than `max_edge` [m]."""
        mesh = self.mesh
        while max_edge is not None and longest_edge(mesh) > max_edge:
            mesh = halve_long_edges(mesh, max_edge)
        return mesh

    @cached_property
    def _bounding_faces(self) -> NDArray[np.int64]:
        """Faces between inside and outside: all of them, unless parts overlap and bury some."""
        faces = self.mesh.faces.astype(np.int64)
        if not self.parts_overlap:
            return faces
        towards_corners = np.vstack([0.98 * np.eye(3) + 0.02 / 3.0, np.full((1, 3), 1.0 / 3.0)])
        points = np.einsum("pc,fcx->fpx", towards_corners, self.mesh.corners)
        outer = points + self._probe_step(self.mesh.area_vectors)[:, None]
        buried = np.all(self.winding_number(outer.reshape(-1, 3)).reshape(points.shape[:2]) > 0.5, axis=1)
        return faces[~buried]

    def _probe_step(self, area_vectors: NDArray[np.float64]) -> NDArray[np.float64]:
        length = np.linalg.norm(area_vectors, axis=1, keepdims=True)
        diagonal = np.linalg.norm(np.ptp(self.mesh.vertices, axis=0))
        return _PROBE_OFFSET * diagonal * area_vectors / np.maximum(length, np.finfo(np.float64).tiny)

    @cached_property
    def _distance_tree(self) -> Any:
        import igl

        tree = igl.AABB()
        tree.init(self.mesh.vertices, self._bounding_faces)
        return tree

    @cached_property
    def _winding_tree(self) -> Any:
        import igl

        tree = igl.FastWindingNumberBVH()
        uncapped = self.mesh.faces[: len(self.mesh.faces) - self.cap_count].astype(np.int64)
        tree.init(self.mesh.vertices, uncapped, 2)
        return tree


@dataclass(frozen=True, eq=False)
class ConvexSolid(MeshSolid):
    """A convex mesh, which has the same numbers for less work."""

    @property
    def parts_overlap(self) -> bool:
        """No surface is buried in the solid."""
        return False

    def winding_number(self, points: Points) -> NDArray[np.float64]:
        """1 inside and 0 outside, (n,)."""
        normal = self.mesh.area_vectors
        height = np.asarray(points) @ normal.T - np.einsum("fi,fi->f", normal, self.mesh.corners[:, 0])
        return (height <= 0.0).all(axis=1).astype(np.float64)


def solid_from_triangles(vertices: ArrayLike, faces: ArrayLike, *, label: str) -> MeshSolid:
    """Repair a mesh of vertices (n, 3) [m] and faces (m, 3), which messages call by its label.

    Raises:
        ShapeError: no faces, no extent, non-finite vertices, or an inside that cannot be determined: beside a fifth of
            the surface the winding number is not within 0.1 of an integer, or the inner side is not inside.
    """
    vertices, faces = _checked_arrays(vertices, faces, label)
    warnings = []
    faces, turned = orient_outward(vertices, faces)
    if turned == len(faces):
        warnings.append(f"{label} was inside out; all of its {turned} faces were turned")
    elif turned:
        warnings.append(f"{turned} of the {len(faces)} faces of {label} pointed the wrong way and were turned")

    open_edges = boundary_edges(faces)
    loops = boundary_loops(faces)
    capped_vertices, caps = cap_holes(vertices, faces, loops)
    mesh = TriangleMesh(capped_vertices, np.concatenate([faces, caps]).astype(np.int32))
    solid = MeshSolid(mesh, len(caps))

    undecided = _undecided_fraction(solid)
    if undecided > _LARGEST_UNDECIDED:
        raise ShapeError(_no_inside(label, undecided, len(loops), len(open_edges)))
    if loops:
        holes = "a hole" if len(loops) == 1 else f"{len(loops)} holes"
        warnings.append(
            f"{label} has {holes} ({len(open_edges)} boundary edges); its inside is taken from the generalized "
            f"winding number, decided beside {100.0 * (1.0 - undecided):.1f} % of the surface, and flat caps close it"
        )
    elif undecided > _WORTH_A_WARNING:
        warnings.append(
            f"{label} folds into itself: beside {100.0 * undecided:.1f} % of its surface the winding number finds no "
            "inside, and there it counts as outside"
        )
    if solid.parts_overlap:
        warnings.append(f"{label} has parts that overlap; they are united")
    return MeshSolid(mesh, len(caps), tuple(warnings))


def _checked_arrays(vertices: ArrayLike, faces: ArrayLike, label: str) -> tuple[Points, NDArray[np.int64]]:
    vertices = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.asarray(faces, dtype=np.int64).reshape(-1, 3)
    if not len(faces):
        raise ShapeError(f"{label} has no faces; a solid needs a surface, so export it as a triangle mesh")
    vertices, faces = vertices[np.unique(faces)], np.unique(faces, return_inverse=True)[1].reshape(-1, 3)
    bad = np.count_nonzero(~np.isfinite(vertices).all(axis=1))
    if bad:
        raise ShapeError(f"{label} has {bad} vertices that are not finite numbers; export it again")
    extent = np.ptp(vertices, axis=0)
    if not np.any(extent > 0.0):
        raise ShapeError(f"{label} has no extent: all of its vertices are in one place; check its export")
    vertices, faces = merge_vertices(vertices, faces)
    faces = drop_collapsed_and_repeated_faces(faces)
    if not len(faces) or not np.all(np.ptp(vertices, axis=0) > 1.0e-9 * extent.max()):
        raise ShapeError(
            f"{label} is flat: its extent is {' x '.join(f'{edge:g}' for edge in extent)} m; "
            "a solid needs thickness, so give the sheet some in a modelling program"
        )
    return vertices, faces


def _undecided_fraction(solid: MeshSolid) -> float:
    winding = solid.winding_beside_surface()
    decided = np.all(np.abs(winding - np.round(winding)) < _DECIDED_WITHIN, axis=1)
    return 1.0 - float(np.mean(decided & (winding[:, 0] > 0.5)))


def _no_inside(label: str, undecided: float, holes: int, open_edges: int) -> str:
    finding = (
        f"{label} has no clear inside: beside {100.0 * undecided:.0f} % of its surface the winding number is undecided "
        f"(at most {100.0 * _LARGEST_UNDECIDED:.0f} % may be), "
    )
    if holes:
        return (
            f"{finding}{open_edges} edges being open; close its holes, or give the sheet a thickness, in a modelling "
            "program"
        )
    return (
        f"{finding}although it has no holes: it folds over or into itself; rebuild it in a modelling program (Blender: "
        "Remesh modifier)"
    )


def merge_vertices(vertices: Points, faces: Faces) -> tuple[Points, Faces]:
    """Join vertices in the same place, and drop those that no face uses."""
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    snapped = np.round((vertices - vertices.min(axis=0)) / (_MERGE_DISTANCE * diagonal)).astype(np.int64)
    _, first, merged = np.unique(snapped, axis=0, return_index=True, return_inverse=True)
    used, faces = np.unique(merged.reshape(-1)[faces], return_inverse=True)
    return vertices[first[used]], faces.reshape(-1, 3)


def drop_collapsed_and_repeated_faces(faces: Faces) -> Faces:
    """Without the faces that have a corner twice, and without second copies of a face."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    smallest_first = np.argmin(faces, axis=1)[:, None]
    canonical = np.take_along_axis(faces, (smallest_first + np.arange(3)) % 3, axis=1)
    _, first = np.unique(canonical, axis=0, return_index=True)
    return faces[np.sort(first)]


def boundary_loops(faces: Faces) -> list[list[int]]:
    """The boundary as simple loops of vertices; a boundary always closes, as it is one."""
    following: dict[int, list[int]] = {}
    for start, end in boundary_edges(faces)[::-1].tolist():
        following.setdefault(start, []).append(end)
    loops = []
    for start in list(following):
        while following[start]:
            path, place = [start], {start: 0}
            while following[path[-1]]:
                vertex = following[path[-1]].pop()
                if vertex not in place:
                    place[vertex] = len(path)
                    path.append(vertex)
                    continue
                loop = path[place[vertex] :]
                loops.append(loop)
                del path[place[vertex] + 1 :]
                for left in loop[1:]:
                    del place[left]
    return loops


def cap_holes(vertices: Points, faces: Faces, loops: list[list[int]]) -> tuple[Points, Faces]:
    """Close every loop with a fan around its centroid; returns all vertices, and the caps alone.

    A loop around a lone triangle is left open: its cap would be the triangle's own back.
    """
    own = {tuple(corners) for corners in np.sort(faces, axis=1).tolist()}
    centres: list[NDArray[np.float64]] = []
    caps: list[tuple[int, int, int]] = []
    for loop in loops:
        if len(loop) == 3:
            if tuple(sorted(loop)) not in own:
                caps.append((loop[2], loop[1], loop[0]))
            continue
        centre = len(vertices) + len(centres)
        centres.append(vertices[loop].mean(axis=0))
        caps.extend((end, start, centre) for start, end in zip(loop, [*loop[1:], loop[0]], strict=True))
    if centres:
        vertices = np.concatenate([vertices, centres])
    return vertices, np.array(caps, dtype=np.int64).reshape(-1, 3)


def orient_outward(vertices: Points, faces: Faces) -> tuple[Faces, int]:
    """Turn faces so that neighbours agree and normals point out; returns the faces and how many were turned.

    Neighbours across an edge of two faces are made to agree with the majority of their patch. Then the whole mesh is
    turned if it encloses a negative volume, and each closed patch that does so without being a cavity, which is one
    that lies inside of the rest.
    """
    import igl

    agreeing, patch = igl.bfs_orient(faces)
    turned = _orientation_sign(agreeing) != _orientation_sign(faces)
    majority_turned = np.bincount(patch, weights=turned) > 0.5 * np.bincount(patch)
    oriented = _turn(agreeing, majority_turned[patch])

    centred = vertices - vertices.mean(axis=0)
    capped_vertices, caps = cap_holes(centred, oriented, boundary_loops(oriented))
    whole = TriangleMesh(capped_vertices, np.concatenate([oriented, caps]).astype(np.int32))
    if whole.signed_volume < 0.0:
        oriented = _turn(oriented, np.ones(len(oriented), dtype=bool))
    oriented = _turn_closed_patches(centred, oriented, patch)
    return oriented, int(np.count_nonzero(_orientation_sign(oriented) != _orientation_sign(faces)))


def _turn_closed_patches(vertices: Points, faces: Faces, patch: NDArray[np.int64]) -> Faces:
    import igl

    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = np.bincount(patch, weights=np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)
    for inverted in np.flatnonzero(volume < 0.0):
        own = patch == inverted
        if len(boundary_edges(faces[own])):
            continue
        others = faces[~own]
        if len(others):
            corners = np.unique(faces[own])
            probes = vertices[corners[:: 1 + len(corners) // _CAVITY_PROBES]]
            if np.all(igl.winding_number(vertices, others, probes) > 0.5):
                continue  # a cavity
        faces = _turn(faces, own)
    return faces


def _turn(faces: Faces, which: NDArray[np.bool_]) -> Faces:
    return np.where(which[:, None], faces[:, ::-1], faces)


def _orientation_sign(faces: Faces) -> NDArray[np.bool_]:
    """Whether the corners, by index, are an even permutation of their order."""
    a, b, c = faces.T
    return (a < b) ^ (b < c) ^ (c < a)
