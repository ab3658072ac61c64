"""What whitewater must not enter: the domain's walls, and rigid bodies that may move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from sim.core.domain import DomainParameters
from sim.core.snapshots import Snapshot
from sim.shapes.level_set import LevelSet
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.shapes.solid import TriangleMesh

Float64Array = NDArray[np.float64]

_FINEST_GRID = 128  # most cells of a body along its longest edge, 2 million in all: sampled in every process
_PUSHES = 3  # rounds of pushing points out of bodies and walls: corners between two need two, a third most of the rest


@dataclass(frozen=True)
class Pose:
    """Where a body is: its mesh at rest is turned, then moved."""

    position: Float64Array  # [m], (3,), float64
    orientation: Float64Array  # unit quaternion w, x, y, z, (4,), float64

    @classmethod
    def of_snapshot(cls, snapshot: Snapshot) -> Pose:
        """The pose of a rigid body's snapshot."""
        arrays = snapshot.arrays
        return cls(np.asarray(arrays["position"], np.float64), np.asarray(arrays["orientation"], np.float64))

    @property
    def rotation(self) -> Rotation:
        """Rest axes to world axes."""
        return Rotation.from_quat(self.orientation, scalar_first=True)

    def placed(self, rest_points: Float64Array) -> Float64Array:
        """World positions of points of the body (n, 3)."""
        return self.rotation.apply(rest_points) + self.position

    def at_rest(self, points: Float64Array) -> Float64Array:
        """Points of the body at world positions (n, 3)."""
        return self.rotation.inv().apply(points - self.position)


def sample_at_rest(body: Placement, particle_radius: float) -> LevelSet:
    """Signed distances of a body before it is turned and moved, as finely as the fluid can tell.

    Raises:
        ShapeError: its shape cannot be built.
    """
    solid = build_solid(Placement(shape=body.shape, scale=body.scale))
    longest = float(np.max(solid.bounds[1] - solid.bounds[0]))
    return LevelSet.sample(solid, max(particle_radius, longest / _FINEST_GRID))


def deformed(before: Snapshot, now: Snapshot, particle_radius: float) -> MovingObstacle:
    """An animated body between two frames, by its meshes in them; its distances are those of the later one."""
    begin, end = Pose.of_snapshot(before), Pose.of_snapshot(now)
    vertices, was = (
        pose.at_rest(np.asarray(each.arrays["vertices"], np.float64)) for pose, each in ((end, now), (begin, before))
    )
    solid = MeshSolid(TriangleMesh(vertices, np.asarray(now.arrays["triangles"], np.int32)))
    longest = float(np.max(np.ptp(vertices, axis=0)))
    level_set = LevelSet.sample(solid, max(particle_radius, longest / _FINEST_GRID))
    return MovingObstacle(level_set, begin, end, SurfaceMotion(cKDTree(vertices), vertices - was))


@dataclass(frozen=True)
class SurfaceMotion:
    """How far points of a surface got in a body's own axes."""

    tree: cKDTree  # of the points at the later frame [m]
    moved: Float64Array  # of each since the earlier one [m], (n, 3)

    def at(self, points: Float64Array) -> Float64Array:
        """That of the nearest points [m], (k, 3)."""
        found: Float64Array = self.moved[self.tree.query(points)[1]]
        return found


@dataclass(frozen=True)
class MovingObstacle:
    """A body between two frames."""

    level_set: LevelSet  # signed distances at rest [m]
    begin: Pose  # pose at the earlier frame
    end: Pose  # pose at the later frame
    surface: SurfaceMotion | None = None  # of one that deforms

    def pose(self, share: float) -> Pose:
        """The pose when a share of the time between the frames has passed: straight and by the shortest turn."""
        turn = Slerp([0.0, 1.0], Rotation.concatenate([self.begin.rotation, self.end.rotation]))
        position = self.begin.position + share * (self.end.position - self.begin.position)
        return Pose(position, turn(share).as_quat(scalar_first=True))


class Obstacles:
    """Walls and bodies between two frames."""

    def __init__(self, domain: DomainParameters, bodies: Sequence[MovingObstacle], frame_dt: float) -> None:
        low, high = np.asarray(domain.min), np.asarray(domain.max)
        is_open = np.array([[f"{axis}{side}" in domain.open_faces for axis in "xyz"] for side in "-+"])
        self._low, self._high = _rounded_inwards(low, np.inf), _rounded_inwards(high, -np.inf)
        self._wall_low = np.where(is_open[0], -np.inf, self._low)
        self._wall_high = np.where(is_open[1], np.inf, self._high)
        self._bodies = tuple(bodies)
        self._frame_dt = frame_dt

    def collide(
        self, position: Float64Array, velocity: Float64Array, share: float
    ) -> tuple[Float64Array, Float64Array, NDArray[np.bool_], NDArray[np.bool_]]:
        """Move points out of walls and bodies, and take away the velocity that leads into them.

        Positions [m] and velocities [m/s] are (n, 3); `share` of the time between the frames has passed [-].

        Returns:
            Position, velocity, which points touched something, and which are to stay: those neither beyond an open
            face nor caught inside a body, as between it and a wall.
        """
        position, velocity = position.copy(), velocity.copy()
        touched = np.zeros(len(position), dtype=bool)
        poses = [body.pose(share) for body in self._bodies]
        for _ in range(_PUSHES):
            pushed = np.zeros(len(position), dtype=bool)
            for body, pose in zip(self._bodies, poses, strict=True):
                pushed |= self._push_out(body, pose, position, velocity)
            self._keep_in_walls(position, velocity, pushed)
            touched |= pushed
            if not pushed.any():
                break
        inside = np.all((position >= self._low) & (position <= self._high), axis=1)
        for body, pose in zip(self._bodies, poses, strict=True):
            rows, _ = _points_inside(body, pose, position)
            inside[rows] = False
        return position, velocity, touched, inside

    def mirrored(self, position: Float64Array, velocity: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Points beyond closed faces, and how they move, as their mirror images in these; (n, 3) [m] and [m/s]."""
        below, above = position < self._wall_low, position > self._wall_high
        position = np.where(below, 2.0 * self._wall_low - position, position)
        position = np.where(above, 2.0 * self._wall_high - position, position)
        return position, np.where(below | above, -velocity, velocity)

    def free_share(self, position: Float64Array, radius: float, share: float) -> Float64Array:
        """Share of the ball about each point that is in front of walls and bodies, taken as flat [-], (n,).

        Of a ball of radius h, a plane at distance a h from its centre cuts off (1 - a)² (2 + a) / 4.
        """
        free = np.ones(len(position))
        for distance in (position - self._wall_low, self._wall_high - position):
            free *= np.prod(1.0 - _cut_off(distance / radius), axis=1)
        for body in self._bodies:
            rows, rest = _points_near(body, body.pose(share), position, radius)
            free[rows] *= 1.0 - _cut_off(body.level_set.signed_distance(rest) / radius)
        return free

    def _push_out(
        self, body: MovingObstacle, pose: Pose, position: Float64Array, velocity: Float64Array
    ) -> NDArray[np.bool_]:
        """Move the points that are inside to the surface; in place. Returns which they are."""
        pushed = np.zeros(len(position), dtype=bool)
        rows, rest = _points_inside(body, pose, position)
        if len(rows) == 0:
            return pushed
        pushed[rows] = True
        gradient = body.level_set.gradient(rest)
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        # On a medial axis the gradient vanishes and any way out is as good as another.
        normal = np.where(length > 1e-6, gradient / np.maximum(length, 1e-6), np.array([0.0, 0.0, 1.0]))
        depth = -body.level_set.signed_distance(rest)[:, None]
        # A little beyond the surface, as interpolated distances are not quite those along the way.
        moved = rest + (depth + 0.01 * body.level_set.spacing) * normal
        position[rows] = pose.placed(moved)
        outwards = pose.rotation.apply(normal)
        came_from = rest if body.surface is None else rest - body.surface.at(rest)
        surface_velocity = (body.end.placed(rest) - body.begin.placed(came_from)) / self._frame_dt
        inflow = np.minimum(np.einsum("ij,ij->i", velocity[rows] - surface_velocity, outwards), 0.0)
        velocity[rows] -= inflow[:, None] * outwards
        return pushed

    def _keep_in_walls(self, position: Float64Array, velocity: Float64Array, touched: NDArray[np.bool_]) -> None:
        """Clamp to the closed faces, in place."""
        below, above = position < self._wall_low, position > self._wall_high
        np.clip(position, self._wall_low, self._wall_high, out=position)
        velocity[below] = np.maximum(velocity[below], 0.0)
        velocity[above] = np.minimum(velocity[above], 0.0)
        touched |= (below | above).any(axis=1)


def _points_near(
    body: MovingObstacle, pose: Pose, position: Float64Array, margin: float
) -> tuple[NDArray[np.intp], Float64Array]:
    """Rows of the points in a body's box, widened by a margin [m], and these points in the body's rest axes."""
    low, high = body.level_set.bounds + np.array([[-margin], [margin]])
    reach = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    rows = np.flatnonzero(np.all(np.abs(position - pose.position) <= reach, axis=1))
    rest = pose.at_rest(position[rows])
    in_box = np.all((rest >= low) & (rest <= high), axis=1)
    return rows[in_box], rest[in_box]


def _points_inside(body: MovingObstacle, pose: Pose, position: Float64Array) -> tuple[NDArray[np.intp], Float64Array]:
    """Rows of the points that are inside a body, and these points in the body's rest axes."""
    rows, rest = _points_near(body, pose, position, 0.0)
    inside = body.level_set.signed_distance(rest) < 0.0
    return rows[inside], rest[inside]


def _rounded_inwards(corner: Float64Array, inwards: float) -> Float64Array:
    """A corner of the domain as float32 positions have it, and not beyond it."""
    rounded = corner.astype(np.float32)
    outside = (corner - rounded.astype(np.float64)) * np.sign(inwards) > 0.0
    return np.where(outside, np.nextafter(rounded, np.float32(inwards)), rounded).astype(np.float64)


def _cut_off(distance: Float64Array) -> Float64Array:
    """Share of a unit ball beyond a plane at a distance from its centre; half of it at most."""
    a = np.clip(distance, 0.0, 1.0)
    return (1.0 - a) ** 2 * (2.0 + a) / 4.0
