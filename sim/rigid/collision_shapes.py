"""Tables of shapes, with their balls and distances, as the kernel of contacts reads them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.core.host_access import put
from sim.rigid import collision_kernels as kernels
from sim.rigid.contacts import FEATURE_BITS, WALL_BITS, Array, Indices
from sim.rigid.polytope_kernels import Polytopes
from sim.rigid.polytopes import Polytope, polytope_of
from sim.rigid.tables import kept
from sim.shapes.balls import Balls
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.deformation import Deformation
from sim.shapes.mesh_solid import ConvexSolid
from sim.shapes.primitives import Box, Capsule, Cone, Cylinder, Sphere, Torus
from sim.shapes.revolved import Revolved
from sim.shapes.solid import ShapeError

SLANT = 0.03  # how far outside of a ball's cone a contact normal may be [rad]
SLANT_ON_GRIDS = 0.3  # likewise, on distance grids, whose normals are no better than this [rad]

_SIZES: dict[type, tuple[int, Callable[[Any], tuple[float, float, float]]]] = {
    Sphere: (kernels.SPHERE, lambda shape: (shape.radius, 0.0, 0.0)),
    Box: (kernels.BOX, lambda shape: tuple(0.5 * edge for edge in shape.size)),
    Cylinder: (kernels.CYLINDER, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Capsule: (kernels.CAPSULE, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Torus: (kernels.TORUS, lambda shape: (shape.major_radius, shape.minor_radius, 0.0)),
    Cone: (kernels.CONE, lambda shape: (shape.radius, shape.height, 0.0)),
}
"""Kind and size of a primitive, as `distance_to` takes them."""


class CollisionShapes:
    """The shapes of all bodies, each once, however many bodies have it.

    Attributes:
        of_body: number of the shape of each body, (b,) int32.
        on_device: what `find_contacts` reads, in the device's memory, which keeps it.
        most_balls: of a shape.
        polytopes: those shapes that are, on the device.
        most_vertices: of one of them.
    """

    def __init__(self, geometries: Sequence[BodyGeometry]) -> None:
        shapes = list({id(geometry): geometry for geometry in geometries}.values())
        numbers = {id(geometry): number for number, geometry in enumerate(shapes)}
        self.of_body = np.array([numbers[id(geometry)] for geometry in geometries], dtype=np.int32)
        whole, sizes = np.zeros((len(shapes), 11), dtype=np.int32), np.zeros((len(shapes), 19))
        found = [polytope_of(geometry) for geometry in shapes]
        if not any(isinstance(geometry.solid.shape, ConvexSolid) for geometry in shapes):
            # Spheres are as exact by their balls.
            found = [
                None if isinstance(each.solid.shape, Sphere) else own for each, own in zip(shapes, found, strict=True)
            ]
        # Between polytopes nobody asks for balls and distances.
        is_asked = any(each is None for each in found)
        balls, clusters = [np.zeros((1, 8))], [np.zeros((1, 4))]
        values, edges = [np.zeros(1, dtype=np.float32)], [np.zeros((1, 4))]
        for number, geometry in enumerate(shapes):
            shape, row, size = geometry.solid.shape, whole[number], sizes[number]
            size[kernels.CENTRE :][:3], size[kernels.LOW :][:3] = geometry.centre_of_mass, geometry.bounds[0]
            size[kernels.HIGH :][:3], size[kernels.REACH] = geometry.bounds[1], min(geometry.reach, kernels.FAR)
            size[kernels.SLANT] = SLANT
            if is_asked or geometry.is_analytic:
                size[kernels.STEP] = geometry.normal_step
            if type(shape) in _SIZES:
                row[kernels.KIND], size_of = _SIZES[type(shape)]
                size[kernels.SIZE :][:3] = geometry.solid.scale * np.asarray(size_of(shape))
            elif isinstance(shape, Revolved):
                start, end = (geometry.solid.scale * each for each in shape.segments)
                row[kernels.KIND], row[kernels.FIRST_EDGE] = kernels.PROFILE, sum(map(len, edges))
                row[kernels.EDGES] = len(start)
                edges.append(np.concatenate([start, end - start], axis=1))
            elif is_asked:
                grid = geometry.grid
                row[kernels.KIND], row[kernels.FIRST_VALUE] = kernels.GRID, sum(map(len, values))
                row[kernels.NODES :][:3] = grid.values.shape
                size[kernels.ORIGIN :][:3], size[kernels.SPACING] = grid.origin, grid.spacing
                size[kernels.SLANT] = SLANT_ON_GRIDS
                values.append(grid.values.ravel())
            if not is_asked:
                continue
            own = _in_clusters(geometry.balls)
            row[kernels.FIRST_BALL], row[kernels.BALLS] = sum(map(len, balls)), len(own)
            groups = _clusters_of(own)
            row[kernels.FIRST_CLUSTER], row[kernels.CLUSTERS] = sum(map(len, clusters)), len(groups)
            balls.append(own)
            clusters.append(groups)
        tables = kernels.Shapes(whole, sizes, *(np.concatenate(parts) for parts in (balls, clusters, values, edges)))
        self.on_device = kernels.Shapes(*map(kept, tables))
        self._deforming = [
            _DeformingShape(number, geometry.deformation, geometry.centre_of_mass, tables)
            for number, geometry in enumerate(shapes)
            if geometry.deformation is not None
        ]
        self._tables, self._time_s = tables, -np.inf
        self.most_balls = int(whole[:, kernels.BALLS].max())
        if self.most_balls > 1 << (FEATURE_BITS - WALL_BITS):
            raise ShapeError(f"a shape of {self.most_balls:,} balls is too large for contacts; make it less slender")
        self._is_polytope = np.array([each is not None for each in found])
        self.polytopes = Polytopes(*map(kept, _tables_of(found)))
        self.most_vertices = max((len(each.vertices) for each in found if each is not None), default=0)
        sides = np.zeros((len(shapes), len(shapes)), dtype=np.int32)
        if is_asked:
            sides[:] = [[_sides(one, two) for two in shapes] for one in shapes]
        self._sides = np.where(self._is_polytope[:, None] & self._is_polytope, 0, sides)

    @property
    def has_polytopes(self) -> bool:
        """Whether there is one."""
        return bool(self._is_polytope.any())

    @property
    def has_others(self) -> bool:
        """Whether there is another shape."""
        return not self._is_polytope.all()

    def deform(self, time_s: float) -> None:
        """Take shapes that deform as they are at a time [s]."""
        if not self._deforming or time_s == self._time_s:
            return
        self._time_s = time_s
        for shape in self._deforming:
            shape.put_into(self._tables, time_s)
        for name in ("balls", "clusters", "values"):
            put(getattr(self.on_device, name), getattr(self._tables, name))

    def sides(self, first: Indices, second: Indices) -> NDArray[np.int32]:
        """Whose balls are to be looked at in pairs of bodies: 1 the first's, 2 the second's, 3 both, (k,).

        0 where both are polytopes.
        """
        return self._sides[self.of_body[first], self.of_body[second]]

    def sides_at_wall(self, bodies: Indices) -> NDArray[np.int32]:
        """Likewise of bodies and walls, (k,)."""
        result: NDArray[np.int32] = np.where(self._is_polytope[self.of_body[bodies]], 0, 1)
        return result


def _tables_of(shapes: Sequence[Polytope | None]) -> Polytopes:
    """What kernels read of polytopes, in the host's memory."""
    found = [each for each in shapes if each is not None]
    none = Polytope(0.0, np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    whole = np.zeros((len(shapes), 4), dtype=np.int32)
    whole[:, 1::2] = [[len(each.vertices), len(each.planes)] for each in (shape or none for shape in shapes)]
    whole[:, ::2] = np.cumsum(whole[:, 1::2], axis=0) - whole[:, 1::2]
    counts = np.concatenate([each.counts for each in found] or [none.counts])
    rows = [(each.vertices, each.planes, each.corners) for each in found]
    rows.append((np.zeros((1, 3)), np.zeros((1, 4)), np.zeros(1, dtype=np.int64)))  # there is one at least
    vertices, planes, corners = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    loops = np.stack([np.cumsum(counts) - counts, counts], axis=1)
    return Polytopes(
        whole,
        np.array([(each or none).radius for each in shapes]),
        vertices,
        planes,
        np.concatenate([loops, np.zeros((1, 2), dtype=np.int64)]).astype(np.int32),
        corners.astype(np.int32),
    )


def _sides(one: BodyGeometry, two: BodyGeometry) -> int:
    if one.sees_all_contacts_with(two):
        return 1
    return 2 if two.sees_all_contacts_with(one) else 3


class _DeformingShape:
    """One of the shapes of the tables, whose balls are fixed to its surface and whose distances change."""

    def __init__(self, number: int, deformation: Deformation, centre: Array, tables: kernels.Shapes) -> None:
        row = tables.whole[number]
        self._deformation, self._centre, self._first_value = deformation, centre, int(row[kernels.FIRST_VALUE])
        first, count = int(row[kernels.FIRST_BALL]), int(row[kernels.BALLS])
        self._balls = slice(first, first + count)
        self._clusters = slice(row[kernels.FIRST_CLUSTER], row[kernels.FIRST_CLUSTER] + row[kernels.CLUSTERS])
        own = tables.balls[self._balls]
        self._attachment, self._axes = deformation.attach(own[:, :3] + centre), own[:, 4:7].copy()
        self._rest = deformation.vertices(-np.inf)[0]

    def put_into(self, tables: kernels.Shapes, time_s: float) -> None:
        """Note in the tables where the shape is at a time [s]."""
        vertices, _ = self._deformation.vertices(time_s)
        own = tables.balls[self._balls]
        own[:, :3] = self._attachment.at(vertices) - self._centre
        own[:, 4:7] = self._attachment.turned(self._rest, vertices, self._axes)
        tables.clusters[self._clusters] = _clusters_of(own)
        values = self._deformation.level_set(time_s).values.ravel()
        tables.values[self._first_value : self._first_value + len(values)] = values


def _in_clusters(balls: Balls) -> Array:
    """The balls of a shape, (m, 8), neighbours together: the leaves of a tree that halves them by median."""
    table = np.concatenate([balls.centres.T, balls.radii[:, None], balls.axes.T, balls.cones[:, None]], axis=1)
    order: list[Indices] = []
    stack = [np.arange(len(table))]
    while stack:
        rows = stack.pop()
        if len(rows) <= kernels.BALLS_PER_CLUSTER:
            order.append(rows)
            continue
        axis = int(np.argmax(np.ptp(table[rows, :3], axis=0)))
        rows = rows[np.argsort(table[rows, axis], kind="stable")]
        clusters = -(-len(rows) // kernels.BALLS_PER_CLUSTER)
        half = kernels.BALLS_PER_CLUSTER * (clusters // 2)  # all clusters but the last are full
        stack += [rows[half:], rows[:half]]
    return table[np.concatenate(order)]


def _clusters_of(balls: Array) -> Array:
    """Centre and radius of a ball around each of the clusters, (c, 4)."""
    clusters = []
    for begin in range(0, len(balls), kernels.BALLS_PER_CLUSTER):
        own = balls[begin : begin + kernels.BALLS_PER_CLUSTER]
        centre = 0.5 * (own[:, :3].min(axis=0) + own[:, :3].max(axis=0))
        radius = (np.sqrt(np.square(own[:, :3] - centre).sum(axis=1)) + own[:, 3]).max()
        clusters.append([*centre, radius])
    return np.array(clusters)
