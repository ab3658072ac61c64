"""Checks of air in closed boxes of smoke: nothing may come in and press on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.model.boxes import Box, overlap, smoke_box
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.smoke.parameters import SmokeParameters

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.rigid.parameters import RigidBodyParameters
    from sim.shapes import PlacedSolid

SQUEEZED = 0.001
"""Share of a closed box by which the air in it may be compressed or stretched without a word."""
POSES = 400
"""Moments of the film at which it is seen how much of a body is in a closed box."""


def check_shut_in_air(
    job: Job, smoke: SmokeParameters, solids: Mapping[KeyPath, PlacedSolid], findings: Findings
) -> None:
    """Note what comes into a smoke's box without an open side, or leaves it, while its air can do neither."""
    box = smoke_box(smoke, job.domain)
    if smoke.open_faces or np.any(box[1] <= box[0]):
        return
    room = float(np.prod(box[1] - box[0]))
    for index, body in enumerate(job.rigid):
        solid = solids.get(("rigid", index))
        if body.kind == "kinematic" and solid is not None:
            shares = _shares_inside(job, body, solid, box)
            more, less = (solid.volume / room * abs(float(end - shares[0])) for end in (shares.max(), shares.min()))
            if max(more, less) > SQUEEZED:
                way, flow = ("comes into", "out") if more >= less else ("leaves", "in")
                findings.warn(
                    ("rigid", index),
                    f'{way} the box of smoke "{smoke.name}", of which it takes about {100.0 * max(more, less):.2g} %, '
                    f"and {_as_much_must_flow(flow)}",
                )
    for index, fluid in enumerate(job.fluid):
        for number, emitter in enumerate(fluid.emitter):
            filled = min(emitter.emitted_volume(job.frame_count / job.fps), fluid.most_volume) / room
            is_inside = np.all((box[0] <= emitter.position) & (emitter.position <= box[1]))
            if is_inside and filled > SQUEEZED:
                findings.warn(
                    ("fluid", index, "emitter", number),
                    f'fills about {100.0 * min(1.0, filled):.2g} % of the box of smoke "{smoke.name}", and '
                    f"{_as_much_must_flow('out')}",
                )


def _as_much_must_flow(where: str) -> str:
    return (
        f"no side of that is open: as much air must flow {where}, for air of constant density cannot be compressed; "
        "add a side to its open_faces"
    )


def _shares_inside(job: Job, body: RigidBodyParameters, solid: PlacedSolid, box: Box) -> NDArray[np.float64]:
    """Share of a kinematic body's bounds that is in a box at moments of the film, from its start on [-], (n,)."""
    from sim.core.motion import rotation
    from sim.rigid.paths import path_of
    from sim.shapes import PlacedSolid

    path, film_s = path_of(body), job.frame_count / job.fps
    turns = [key.time_s for key in body.keyframe if key.time_s < film_s]
    poses = [path.at(time) for time in sorted({*np.linspace(0.0, film_s, POSES).tolist(), *turns})]
    places = np.array([pose.position for pose in poses])
    rotations = rotation.matrices(np.array([pose.orientation for pose in poses]))
    at_rest = PlacedSolid(solid.shape, solid.scale, np.eye(3), np.zeros(3))
    reach = np.linalg.norm(np.abs(at_rest.bounds).max(axis=0))
    is_inside = np.all((box[0] <= places - reach) & (places + reach <= box[1]), axis=1)
    is_outside = np.any((places + reach <= box[0]) | (box[1] <= places - reach), axis=1)
    shares: NDArray[np.float64] = is_inside.astype(np.float64)
    near = np.flatnonzero(~(is_inside | is_outside))
    for number, bounds in zip(near.tolist(), _bounds_of_turned(at_rest, rotations[near]), strict=True):
        shares[number] = overlap(places[number] + bounds, box)
    return shares


def _bounds_of_turned(at_rest: PlacedSolid, rotations: NDArray[np.float64]) -> Iterator[Box]:
    """Bounds of a solid about its origin, by rotation matrices (n, 3, 3); of a mesh by its hull, mostly smaller."""
    from scipy.spatial import ConvexHull

    from sim.shapes import PlacedSolid
    from sim.shapes.mesh_solid import MeshSolid

    shape, scale = at_rest.shape, at_rest.scale
    if len(rotations) and np.all(rotations == rotations[0]):
        yield from [PlacedSolid(shape, scale, rotations[0], np.zeros(3)).bounds] * len(rotations)
    elif len(rotations) and isinstance(shape, MeshSolid):
        corners = scale * shape.mesh.vertices[ConvexHull(shape.mesh.vertices).vertices]
        for matrix in rotations:
            turned = corners @ matrix.T
            yield np.stack([turned.min(axis=0), turned.max(axis=0)])
    else:
        for matrix in rotations:
            yield PlacedSolid(shape, scale, matrix, np.zeros(3)).bounds
