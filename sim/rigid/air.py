"""Forces from outside on rigid bodies, among them that of the air on their surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.core.drag import AIR_DENSITY
from sim.forces.field import ForcesOn
from sim.rigid.air_kernels import Samples, push_bodies
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.states import MovingBodies
from sim.shapes.body_geometry import BodyGeometry

SAMPLES = 128
"""Most points of a body's surface at which it feels the air."""
FELT_ASLEEP = 0.1
"""Part of gravity from which on forces wake bodies, and keep them awake [-]: bodies at rest under less may sleep."""

Float64Array = NDArray[np.float64]


NO_SAMPLES = Samples(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1))


class OuterForces:
    """Accelerations, drag and air on dynamic bodies, in every substep before all else.

    Accelerations act at the centre of mass. Air presses on what of a surface it blows onto (Newton 1687, II.34), with
    the coefficient C of the body:

        dF = -1/2 rho C (u.n)² n dA  where u.n < 0,  u = air - surface

    A plate across the wind has a drag coefficient of C, a ball of C/2; a plate aslant has lift, and one that turns is
    slowed. Nothing pulls at lee sides, and nothing rubs. Air and drag take at most what brings a body to rest in it:
    the force is divided by 1 + dt r, r the largest rate at which it slows the body.
    """

    def __init__(
        self, forces: ForcesOn, parameters: Sequence[RigidBodyParameters], solids: Sequence[BodyGeometry]
    ) -> None:
        self._forces = forces
        drag = np.array([body.air_drag if forces.blows else 0.0 for body in parameters])
        self._drag = 0.5 * AIR_DENSITY * drag
        of_solid = {solid: surface_of(solid) for solid in dict.fromkeys(solids)} if forces.blows else {}
        found = [of_solid[solid] for solid in solids] if forces.blows else [NO_SAMPLES]
        self._samples = Samples(*map(np.concatenate, zip(*found, strict=True)))

    def push(self, bodies: MovingBodies, gravity: Float64Array, dt: float) -> None:
        """Let them act on dynamic bodies for dt [s]."""
        change, lost = np.zeros((len(bodies), 6)), np.zeros(len(bodies))
        push_bodies(self._forces.now, self._samples, self._drag, bodies.moving(), dt, change, lost)
        felt = np.sqrt(np.square(change[:, :3]).sum(axis=1))
        wakes = bodies.is_asleep & (felt > FELT_ASLEEP * dt * np.sqrt(np.square(gravity).sum()))
        bodies.wake(wakes)
        change[bodies.is_asleep] = lost[bodies.is_asleep] = 0.0
        bodies.is_pushed = bodies.is_pushed | change.any(axis=1) | (lost > 0.0)
        kept = 1.0 - lost[:, None]
        bodies.velocity = kept * bodies.velocity + change[:, :3]
        bodies.angular_velocity = kept * bodies.angular_velocity + change[:, 3:]


def surface_of(solid: BodyGeometry) -> Samples:
    """The samples of a body's surface, in its frame: of few triangles the middles of their edges, else of patches.

    Middles of edges give forces and moments of a flat face exactly where pressure is even or linear on it.
    """
    mesh = solid.solid.rest_mesh()
    corners = mesh.vertices[mesh.faces] - solid.centre_of_mass
    of_triangles = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if 3 * len(corners) <= SAMPLES:
        points = 0.5 * (corners + np.roll(corners, 1, axis=1)).reshape(-1, 3)
        vectors = np.repeat(of_triangles / 3.0, 3, axis=0)
    else:
        points, vectors = _patches(corners.mean(axis=1), of_triangles)
    areas = np.sqrt(np.square(vectors).sum(axis=1))
    normals = vectors / np.maximum(areas, np.finfo(float).tiny)[:, None]
    room = SAMPLES - len(points)
    return Samples(*(np.pad(each, [(0, room), (0, 0)]) for each in (points, normals)), np.pad(areas, (0, room)))


def _patches(centres: Float64Array, vectors: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Triangles in `SAMPLES` patches at most, each as one: their mean place by area, and the sum of their areas.

    The patch with most area is halved, across the widest of its places (over the body's) and normals.
    """
    areas = np.sqrt(np.square(vectors).sum(axis=1))
    size = np.ptp(centres, axis=0).max()
    features = np.concatenate(
        [2.0 * centres / size, vectors / np.maximum(areas, np.finfo(float).tiny)[:, None]], axis=1
    )
    patches = [np.arange(len(centres))]
    while len(patches) < SAMPLES:
        largest = max(range(len(patches)), key=lambda n: areas[patches[n]].sum() if len(patches[n]) > 1 else -1.0)
        own = patches[largest]
        order = own[np.argsort(features[own, np.ptp(features[own], axis=0).argmax()], kind="stable")]
        half = np.clip(np.searchsorted(np.cumsum(areas[order]), 0.5 * areas[order].sum()), 1, len(order) - 1)
        patches[largest : largest + 1] = [order[:half], order[half:]]
    places = [np.average(centres[own], axis=0, weights=areas[own]) for own in patches]
    return np.array(places), np.array([vectors[own].sum(axis=0) for own in patches])
