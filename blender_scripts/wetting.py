"""Contact of a fluid's surface with what it wets, computed for every vertex of every frame.

A surface made of particles ends a little short of the solid or a little inside of it, and the sliver of air between
them would reflect like a mirror whatever meets it at more than the critical angle (48.6° in water). A liquid that wets
has no air there, so looks let rays straight through where it touches (`looks`, docs/decisions/0035-wet-surfaces.md).
Where two clear fluids meet, the surfaces of both do.

A vessel that light goes through is drawn where it is, not where the particles end: the liquid lets rays straight
through there, and the vessel bends them as between its glass and the liquid that covers it
(docs/decisions/0057-liquid-in-glass.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mathutils import Quaternion
from mathutils.bvhtree import BVHTree

from blender_scripts.geometry import EMPTY_MESH
from blender_scripts.ply import SurfaceMesh
from blender_scripts.sides import Pseudonormals

_TOUCHES_WITHIN, _FREE_BEYOND = 2.0 / 3.0, 4.0 / 3.0
"""Distances between which a surface goes from touching to free, in `reach`."""
_ALONG, _TOWARDS = 0.1, 0.5
"""Cosines between the outward normal and the way to the solid: free below the first, touching above the second. A free
surface that ends at a wall, and the outside of a film, do not face the solid although they are near it."""

_COVER_BLUR = 1.0 / 3.0  # half width of the edge of what covers a solid, in `reach`; looks draw its middle as a line

_NO_WAY = 1.0e-3  # a distance too short to have a direction, in `reach`

_DIP = 0.2  # how deep a surface that may be moved dips into what it touches, in `reach`


@dataclass(frozen=True)
class Touchable:
    """An object that a fluid may touch, with its place: a body, a cloth or another fluid.

    Attributes:
        tree: its triangles, in its own axes; None without any.
        low: lower corner of the box around it, in its own axes [m], (3,).
        high: upper corner [m], (3,).
        outwards: which way is out of it; None of a sheet, which has no inside.
        can_be_entered: whether what touches it may be moved into it. It would come out of a sheet again, and two fluids
            would be moved into each other.
        position: of its origin [m], (3,).
        rotation: from its own axes to the world's, (3, 3).
    """

    tree: Any
    low: np.ndarray
    high: np.ndarray
    outwards: Pseudonormals | None
    can_be_entered: bool
    position: np.ndarray
    rotation: np.ndarray

    @classmethod
    def of(cls, mesh: SurfaceMesh, *, is_closed: bool) -> Touchable:
        """A mesh at the origin. Building its tree is most of the work: a rigid body needs one for all frames."""
        low, high = np.zeros(3), np.zeros(3)
        tree = outwards = None
        if len(mesh.faces):
            low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            tree = BVHTree.FromPolygons(mesh.vertices.tolist(), mesh.faces.tolist(), all_triangles=True)
            outwards = Pseudonormals(mesh.vertices, mesh.faces) if is_closed else None
        return cls(tree, low, high, outwards, is_closed, np.zeros(3), np.eye(3))

    @classmethod
    def of_fluid(cls, surface: SurfaceMesh, *, near: SurfaceMesh, reach: float) -> Touchable:
        """The surface of another fluid, as far as one that wets it within this distance [m] may be near it."""
        if not len(near.vertices):
            return cls.of(EMPTY_MESH, is_closed=True)
        farthest = _FREE_BEYOND * reach
        low, high = near.vertices.min(axis=0) - farthest, near.vertices.max(axis=0) + farthest
        corners = surface.vertices[surface.faces]
        touching = (corners.max(axis=1) >= low).all(axis=1) & (corners.min(axis=1) <= high).all(axis=1)
        used, triangles = np.unique(surface.faces[touching], return_inverse=True)
        part = SurfaceMesh(surface.vertices[used], triangles.reshape(-1, 3))
        return replace(cls.of(part, is_closed=True), can_be_entered=False)

    def to_world(self, own: np.ndarray) -> np.ndarray:
        """Places of its own axes [m], (n, 3), in the world."""
        return own @ self.rotation.T + self.position

    def placed(self, position: Sequence[float], orientation: Sequence[float]) -> Touchable:
        """The same with its origin elsewhere [m], and turned by a unit quaternion (w, x, y, z)."""
        rotation = np.array(Quaternion(orientation).to_matrix())
        return replace(self, position=np.array(position), rotation=rotation)


def wetted(
    mesh: SurfaceMesh,
    *,
    reach: float,
    floor_z: float,
    touchables: Sequence[Touchable],
    dips: bool = False,
) -> tuple[SurfaceMesh, np.ndarray]:
    """A fluid's surface, and how far each vertex touches the floor or a solid: 1 where it does, 0 where it is free.

    Args:
        mesh: the surface, with outward normals.
        reach: distance at which it is half wet, if it faces the solid [m]. What lies inside of a closed solid, or below
            the floor, touches; sheets touch on both sides.
        floor_z: height of the floor [m].
        touchables: bodies, cloths and other fluids.
        dips: move what touches a body or the floor into it.
    """
    assert mesh.normals is not None
    height = mesh.vertices[:, 2] - floor_z
    down = np.broadcast_to((0.0, 0.0, -1.0), mesh.vertices.shape)
    touch = _Touch(np.zeros(len(mesh.vertices)), np.zeros(mesh.vertices.shape), reach)
    touch.add(np.arange(len(height)), np.maximum(height, 0.0), down, -mesh.normals[:, 2], moves=True)
    for touchable in touchables:
        if touchable.tree is not None:
            _add(touch, touchable, mesh)
    if dips:
        mesh = replace(mesh, vertices=(mesh.vertices + touch.moves).astype(np.float32))
    return mesh, touch.wet.astype(np.float32)


def covered(points: np.ndarray, outwards: np.ndarray, *, surface: SurfaceMesh, reach: float) -> np.ndarray:
    """How far a liquid covers places on a solid that light goes through: above 1/2 where it does, (n,) from 0 to 1.

    It does where there is liquid about a particle's radius off the solid, beyond the sliver that its surface leaves.

    Args:
        points: on the solid [m], (n, 3).
        outwards: unit normals there, (n, 3).
        surface: of the liquid.
        reach: as for `wetted` [m].
    """
    probes = SurfaceMesh((points + _TOUCHES_WITHIN * reach * outwards).astype(np.float32), EMPTY_MESH.faces)
    liquid = Touchable.of_fluid(surface, near=probes, reach=reach)
    share = np.zeros(len(points))
    if liquid.tree is None or liquid.outwards is None:
        return share
    numbers, places, triangles = _nearest(liquid, probes.vertices.astype(np.float64), _FREE_BEYOND * reach)
    if len(numbers):
        off = ((probes.vertices[numbers] - places) * liquid.outwards.at(triangles, places)).sum(axis=1)
        distance = np.linalg.norm(probes.vertices[numbers] - places, axis=1)
        blur = _COVER_BLUR * reach
        share[numbers] = 1.0 - _smoothstep(np.copysign(distance, off), -blur, blur)
    return share


def _nearest(touchable: Touchable, own: np.ndarray, farthest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points in an object's axes (n, 3) [m], those within a distance [m] of it: numbers, nearest places, triangles.

    (m,), (m, 3) [m] and (m,).
    """
    candidates = np.flatnonzero(((own > touchable.low - farthest) & (own < touchable.high + farthest)).all(axis=1))
    near, places, triangles = [], [], []
    find = touchable.tree.find_nearest
    for number, point in zip(candidates.tolist(), own[candidates].tolist(), strict=True):
        place, _, triangle, _ = find(point, farthest)
        if place is not None:
            near.append(number)
            places.append(place[:])
            triangles.append(triangle)
    return np.array(near, dtype=np.int64), np.array(places).reshape(-1, 3), np.array(triangles, dtype=np.int64)


@dataclass
class _Touch:
    """Contact of the vertices found so far: how far each touches something (n,), and its way into that (n, 3) [m]."""

    wet: np.ndarray
    moves: np.ndarray
    reach: float

    def add(
        self, numbers: np.ndarray, distance: np.ndarray, inwards: np.ndarray, facing: np.ndarray, *, moves: bool
    ) -> None:
        """Take a solid into account, of which these vertices (m,) are near.

        Args:
            numbers: of the vertices.
            distance: from it [m], 0 inside, (m,).
            inwards: unit vectors into it, (m, 3).
            facing: cosines of the angles between these and the normals, (m,).
            moves: whether what touches it may be moved into it.
        """
        far = _smoothstep(distance, _TOUCHES_WITHIN * self.reach, _FREE_BEYOND * self.reach)
        wet = (1.0 - far) * _smoothstep(facing, _ALONG, _TOWARDS)
        more = wet > self.wet[numbers]
        self.wet[numbers[more]] = wet[more]
        depth = wet * (distance + _DIP * self.reach) if moves else np.zeros(len(wet))
        self.moves[numbers[more]] = depth[more, None] * inwards[more]


def _add(touch: _Touch, touchable: Touchable, mesh: SurfaceMesh) -> None:
    """Take a body, a cloth or a fluid into account, for the vertices near it."""
    own = (mesh.vertices - touchable.position) @ touchable.rotation
    numbers, places, triangles = _nearest(touchable, own, _FREE_BEYOND * touch.reach)
    if not len(numbers):
        return
    way = places - own[numbers]
    distance = np.linalg.norm(way, axis=1)
    towards = way / np.maximum(distance, 1e-12)[:, None]
    if touchable.outwards is not None:
        # The way to the nearest point turns around where the surface dips into the solid, which is as good as touching.
        inwards = -touchable.outwards.at(triangles, places)
        is_outside = (towards * inwards).sum(axis=1) > 0.0
        is_outside &= distance > _NO_WAY * touch.reach
        distance = np.where(is_outside, distance, 0.0)
        inwards = np.where(is_outside[:, None], towards, inwards)
    else:
        inwards = towards
    inwards = inwards @ touchable.rotation.T
    facing = (mesh.normals[numbers] * inwards).sum(axis=1)
    touch.add(numbers, distance, inwards, facing, moves=touchable.can_be_entered)


def _smoothstep(values: np.ndarray, low: float, high: float) -> np.ndarray:
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)
