"""Whether the air in a closed box of smoke keeps its room, or something comes in and presses on it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipeline.job.boxes import Box, overlap, smoke_box
from pipeline.job.positions import KeyPath
from pipeline.job.problems import Findings
from pipeline.stages.inputs import emitted_volume
from sim.smoke.parameters import SmokeParameters

if TYPE_CHECKING:
    from pipeline.job.models import Job
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
            shares = list(_shares_inside(job, body, solid, box))
            more, less = (solid.volume / room * abs(end - shares[0]) for end in (max(shares), min(shares)))
            if max(more, less) > SQUEEZED:
                way, flow = ("comes into", "out") if more >= less else ("leaves", "in")
                findings.warn(
                    ("rigid", index),
                    f'{way} the box of smoke "{smoke.name}", of which it takes about {100.0 * max(more, less):.2g} %, '
                    f"and {_as_much_must_flow(flow)}",
                )
    for index, fluid in enumerate(job.fluid):
        most = math.inf if fluid.max_particles is None else fluid.max_particles * (2.0 * fluid.particle_radius) ** 3
        for number, emitter in enumerate(fluid.emitter):
            filled = min(emitted_volume(emitter, until_s=job.frame_count / job.fps), most) / room
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


def _shares_inside(job: Job, body: RigidBodyParameters, solid: PlacedSolid, box: Box) -> Iterator[float]:
    """Share of a kinematic body's bounds that is in a box at moments of the film, from its start on [-]."""
    from sim.rigid import rotation
    from sim.rigid.keyframes import path_of
    from sim.shapes import PlacedSolid

    path, film_s = path_of(body), job.frame_count / job.fps
    turns = [key.time_s for key in body.keyframe if key.time_s < film_s]
    for time in sorted({*np.linspace(0.0, film_s, POSES).tolist(), *turns}):
        pose = path.at(time)
        placed = PlacedSolid(solid.shape, solid.scale, rotation.matrices(pose.orientation), pose.position)
        yield overlap(placed.bounds, box)
