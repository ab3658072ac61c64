"""Checks of closed boxes of smoke: nothing may come in and press on their air."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.fluid import openings_of
from pipeline.model.boxes import Box, overlap, smoke_box
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.core.motion import rotation
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.parameters import AnimationShape
from sim.shapes.placement import PlacedSolid
from sim.shapes.solid import TriangleMesh
from sim.smoke.parameters import SmokeParameters

# Share of a closed box by which its air may be compressed or stretched.
SQUEEZED = 0.001
# Moments of the film at which the share of a body in the box is computed.
POSES = 400


def check_closed_domain(job: Job, smoke: SmokeParameters, solids: Solids, findings: Findings) -> None:
    """Note what comes into a smoke's box without an open side, or leaves it, while its air can do neither."""
    box = smoke_box(smoke, job.domain)
    if smoke.open_faces or np.any(box[1] <= box[0]):
        return
    room = float(np.prod(box[1] - box[0]))
    for index, body in enumerate(job.rigid):
        solid = solids.get(("rigid", index))
        if body.kind == "kinematic" and solid is not None:
            shares = solid.volume / room * _shares_inside(job, body, solid, box)
            shares *= _growth(job, body, solid)
            more, less = float(shares.max() - shares[0]), float(shares[0] - shares.min())
            if max(more, less) > SQUEEZED:
                verb, flow = ("comes into", "out") if more >= less else ("leaves", "in")
                findings.warn(
                    ("rigid", index),
                    f'{verb} the box of smoke "{smoke.name}", of which it takes about {100.0 * max(more, less):.2g} %, '
                    f"and {_must_flow(flow)}",
                )
    for index, fluid in enumerate(job.fluid):
        for number, opening in openings_of(job, index):
            filled = min(fluid.emitter[number].emitted_volume(job.film_s), fluid.most_volume) / room
            place, _ = opening.first_jet
            is_inside = np.all((box[0] <= place) & (place <= box[1]))
            if is_inside and filled > SQUEEZED:
                findings.warn(
                    ("fluid", index, "emitter", number),
                    f'fills about {100.0 * min(1.0, filled):.2g} % of the box of smoke "{smoke.name}", and '
                    f"{_must_flow('out')}",
                )


def _must_flow(where: str) -> str:
    return (
        f"no side of that is open: as much air must flow {where}, for air of constant density cannot be compressed; "
        "add a side to its open_faces"
    )


def _moments(job: Job, body: RigidBodyParameters) -> list[float]:
    """Times of the film at which a body is looked at [s]."""
    turns = [key.time_s for key in body.keyframe if key.time_s < job.film_s]
    return sorted({*np.linspace(0.0, job.film_s, POSES).tolist(), *turns})


def _growth(job: Job, body: RigidBodyParameters, solid: PlacedSolid) -> NDArray[np.float64]:
    """Volume of a body at the same moments, over that at its start [-], (n,)."""
    moments = np.array(_moments(job, body))
    if not isinstance(body.shape, AnimationShape):
        return np.ones(len(moments))
    from sim.shapes.animation import AnimatedSolid

    assert isinstance(solid.shape, AnimatedSolid), "an animation is built as one"
    volumes = solid.shape.volumes
    grown: NDArray[np.float64] = np.interp(moments - body.shape.start_s, solid.shape.times, volumes / volumes[0])
    return grown


def _shares_inside(job: Job, body: RigidBodyParameters, solid: PlacedSolid, box: Box) -> NDArray[np.float64]:
    """Share of a kinematic body's bounds that is in a box at moments of the film, from its start on [-], (n,)."""
    from scipy.spatial import ConvexHull

    shape = solid.shape
    if isinstance(shape, MeshSolid):
        vertices = shape.mesh.vertices
        shape = MeshSolid(TriangleMesh(vertices[ConvexHull(vertices).vertices], shape.mesh.faces[:0]))
    path = path_of(body)
    poses = [path.at(time_s) for time_s in _moments(job, body)]
    rotations = rotation.matrices(np.array([pose.orientation for pose in poses]))
    at_rest = replace(solid, shape=shape, rotation=np.eye(3), position=np.zeros(3))
    reach = float(np.linalg.norm(np.abs(at_rest.bounds).max(axis=0)))
    shares = []
    for pose, matrix in zip(poses, rotations, strict=True):
        share = overlap(np.stack([pose.position - reach, pose.position + reach]), box)
        if 0.0 < share < 1.0:
            share = overlap(replace(at_rest, rotation=matrix, position=pose.position).bounds, box)
        shares.append(share)
    return np.array(shares)
