"""Forces from outside on rigid bodies, among them that of the air on their surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.drag import AIR_DENSITY
from sim.forces.field import ForcesOn
from sim.rigid.air_kernels import Samples, Whole, push_bodies
from sim.rigid.contacts import Indices
from sim.rigid.glue import Faces, Glue
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.states import MovingBodies
from sim.shapes.body_geometry import BodyGeometry

SAMPLES = 128
"""Most points of a body's surface at which it feels the air."""
FELT_ASLEEP = 0.1
"""Part of gravity from which on forces wake bodies, and keep them awake [-]: bodies at rest under less may sleep."""

Float64Array = NDArray[np.float64]


SAME_PLANE = 1.0e-6  # samples this near to the plane of a glued face, in sizes of the piece, lie on it

NO_SAMPLES = Samples(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))


@dataclass(frozen=True, eq=False)
class _Plane:
    """Where a body is glued to another, in its own axes."""

    face: int  # number of the face
    normal: Float64Array  # outwards, (3,)
    offset: float  # of the plane along it [m]
    area: float  # of the face [m²]

    def holds(self, points: Float64Array, normals: Float64Array, size: float) -> NDArray[np.bool_]:
        """Which points of the surface of a body of some size, (n, 3), lie on it and face its way."""
        faces_it = normals @ self.normal > 1.0 - SAME_PLANE
        result: NDArray[np.bool_] = faces_it & (np.abs(points @ self.normal - self.offset) <= SAME_PLANE * size)
        return result


class OuterForces:
    """Accelerations, drag and air on dynamic bodies, in every substep before all else.

    Accelerations act at the centre of mass. Air presses on what of a surface it blows onto (Newton 1687, II.34), with
    the coefficient C of the body:

        dF = -1/2 rho C (u.n)² n dA  where u.n < 0,  u = air - surface

    A plate across the wind has a drag coefficient of C, a ball of C/2; a plate aslant has lift, and one that turns is
    slowed. Nothing pulls at lee sides, and nothing rubs. Air and drag take at most what brings a body to rest in it:
    the force is divided by 1 + dt r, r the largest rate at which it slows the body. Each piece of a body that breaks
    has its own part of the forces; r is of all that it is glued to, and on faces that are glued nothing blows. Where
    others compute the air around a body (`Surroundings`), that presses in place of this law.
    """

    def __init__(
        self,
        forces: ForcesOn,
        parameters: Sequence[RigidBodyParameters],
        solids: Sequence[BodyGeometry],
        glue: Glue | None = None,
    ) -> None:
        self._forces, self._glue = forces, glue
        drag = np.array([body.air_drag if forces.blows else 0.0 for body in parameters])
        self._drag = 0.5 * AIR_DENSITY * drag
        planes = _planes_of(glue.faces, len(solids)) if glue is not None else [[] for _ in solids]
        of_solid = (
            {solid: surface_of(solid, planes[number]) for number, solid in enumerate(solids)} if forces.blows else {}
        )
        found = [of_solid[solid] for solid in solids] if forces.blows else [NO_SAMPLES]
        self._samples = Samples(*map(np.concatenate, zip(*found, strict=True)))
        self._covers = _covers_of(planes, self._samples, solids) if glue is not None and forces.blows else None

    def push(self, bodies: MovingBodies, gravity: Float64Array, dt: float, is_surrounded: NDArray[np.bool_]) -> None:
        """Let them act on dynamic bodies for dt [s]; no wind acts on those that other air surrounds, (n,)."""
        n, glue = len(bodies), self._glue
        leader, movers = (np.arange(n), bodies) if glue is None else (glue.leader, glue.movers)
        given, pressed, slowing, lost = np.zeros((n, 3)), np.zeros((n, 6)), np.zeros((n, 2)), np.zeros(n)
        tensors = movers.inverse_inertia().reshape(n, 9)
        whole = Whole(movers.position[leader], movers.inverse_mass[leader], tensors[leader])
        now, drag = self._forces.now, np.where(is_surrounded, 0.0, self._drag)
        push_bodies(now, self._open_samples(), drag, bodies.moving(), whole, dt, given, pressed, slowing, lost)
        rates = np.zeros((n, 2))
        np.add.at(rates, leader, slowing)
        pressed *= (dt / (1.0 + dt * rates.max(axis=1)))[leader, None]
        change = dt * given + bodies.inverse_mass[:, None] * pressed[:, :3]
        turn = np.einsum("nij,nj->ni", bodies.inverse_inertia(), pressed[:, 3:])
        mass = np.where(bodies.is_dynamic, bodies.mass, 0.0)
        momentum = np.zeros((n, 3))
        np.add.at(momentum, leader, mass[:, None] * change)
        felt = (np.sqrt(np.square(momentum).sum(axis=1)) * movers.inverse_mass)[leader]
        bodies.wake(bodies.is_asleep & (felt > FELT_ASLEEP * dt * np.sqrt(np.square(gravity).sum())))
        change[bodies.is_asleep] = turn[bodies.is_asleep] = lost[bodies.is_asleep] = 0.0
        bodies.is_pushed = bodies.is_pushed | change.any(axis=1) | turn.any(axis=1) | (lost > 0.0)
        kept = 1.0 - lost[:, None]
        bodies.velocity = kept * bodies.velocity + change
        bodies.angular_velocity = kept * bodies.angular_velocity + turn

    def _open_samples(self) -> Samples:
        """The samples, without what of them glued faces cover."""
        if self._covers is None or self._glue is None:
            return self._samples
        faces, rows, shares = self._covers
        covered = np.bincount(rows, shares * ~self._glue.is_broken[faces], minlength=len(self._samples.areas))
        return self._samples._replace(areas=self._samples.areas * np.maximum(1.0 - covered, 0.0))


def _planes_of(faces: Faces, count: int) -> list[list[_Plane]]:
    """The planes of the faces of each of so many bodies."""
    planes: list[list[_Plane]] = [[] for _ in range(count)]
    area = np.bincount(faces.corner_face, faces.share, minlength=len(faces.first))
    corners = np.searchsorted(faces.corner_face, np.arange(len(faces.first)))
    for face, corner in enumerate(corners):
        normal, place = faces.normal[face], faces.corner[corner]
        planes[faces.first[face]].append(_Plane(face, normal, normal @ place, area[face]))
        planes[faces.second[face]].append(_Plane(face, -normal, -normal @ place, area[face]))
    return planes


def _covers_of(
    planes: Sequence[Sequence[_Plane]], samples: Samples, solids: Sequence[BodyGeometry]
) -> tuple[Indices, Indices, Float64Array]:
    """Which samples faces cover: numbers of faces, of samples, and what part of each is covered, (c,) each."""
    found = [(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))]
    for body, solid in enumerate(solids):
        own = slice(body * SAMPLES, (body + 1) * SAMPLES)
        points, normals = samples.points[own] + solid.centre_of_mass, samples.normals[own]
        for plane in planes[body]:
            rows = body * SAMPLES + np.flatnonzero(plane.holds(points, normals, solid.radius))
            share = plane.area / max(samples.areas[rows].sum(), plane.area)
            found.append((np.full(len(rows), plane.face), rows, np.full(len(rows), share)))
    numbers, rows, shares = map(np.concatenate, zip(*found, strict=True))
    return numbers, rows, shares


def surface_of(solid: BodyGeometry, planes: Sequence[_Plane] = ()) -> Samples:
    """The samples of a body's surface, in its frame: of few triangles the middles of their edges, else of patches.

    Middles of edges give forces and moments of a flat face exactly where pressure is even or linear on it. What lies on
    one of some planes is in patches of its own.
    """
    mesh = solid.solid.rest_mesh()
    corners = mesh.vertices[mesh.faces] - solid.centre_of_mass
    of_triangles = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if 3 * len(corners) <= SAMPLES:
        points = 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)
        vectors = np.repeat(of_triangles / 3.0, 3, axis=0)
    else:
        centres, left = corners.mean(axis=1), np.ones(len(corners), dtype=bool)
        areas = np.sqrt(np.square(of_triangles).sum(axis=1))
        normals = of_triangles / np.maximum(areas, np.finfo(float).tiny)[:, None]
        parts = []
        for plane in planes:
            on = plane.holds(centres + solid.centre_of_mass, normals, solid.radius) & left
            parts.append(np.flatnonzero(on))
            left &= ~on
        parts.append(np.flatnonzero(left))
        points, vectors = _patches(centres, of_triangles, [part for part in parts if len(part)])
    areas = np.sqrt(np.square(vectors).sum(axis=1))
    normals = vectors / np.maximum(areas, np.finfo(float).tiny)[:, None]
    room = SAMPLES - len(points)
    return Samples(*(np.pad(each, [(0, room), (0, 0)]) for each in (points, normals)), np.pad(areas, (0, room)))


def _patches(centres: Float64Array, vectors: Float64Array, patches: list[Indices]) -> tuple[Float64Array, Float64Array]:
    """Triangles in `SAMPLES` patches at most, each as one: their mean place by area, and the sum of their areas.

    Of the patches given that with most area is halved, across the widest of its places (over the body's) and normals.
    """
    areas = np.sqrt(np.square(vectors).sum(axis=1))
    size = np.ptp(centres, axis=0).max()
    features = np.concatenate(
        [2.0 * centres / size, vectors / np.maximum(areas, np.finfo(float).tiny)[:, None]], axis=1
    )
    while len(patches) < SAMPLES:
        largest = max(range(len(patches)), key=lambda n: areas[patches[n]].sum() if len(patches[n]) > 1 else -1.0)
        own = patches[largest]
        order = own[np.argsort(features[own, np.ptp(features[own], axis=0).argmax()], kind="stable")]
        half = np.clip(np.searchsorted(np.cumsum(areas[order]), 0.5 * areas[order].sum()), 1, len(order) - 1)
        patches[largest : largest + 1] = [order[:half], order[half:]]
    places = [np.average(centres[own], axis=0, weights=areas[own]) for own in patches]
    return np.array(places), np.array([vectors[own].sum(axis=0) for own in patches])
