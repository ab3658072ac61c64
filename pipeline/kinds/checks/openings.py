"""Checks of how particles begin: openings of emitters, what these let in, and speeds, of fluids and of soft matter."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.kinds.base import Solids
from pipeline.model.amounts import rounded_down, rounded_up
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path
from sim.fluid.opening import Opening
from sim.fluid.opening_conflicts import opening_problem
from sim.soft.parameters import PARTICLES_PER_CELL_EDGE

if TYPE_CHECKING:
    from sim.fluid.parameters import FluidParameters
    from sim.soft.parameters import SoftParameters

FEWEST_FRAMES_ACROSS = 10
"""A jet by its flow rate that crosses the domain in fewer frames comes out of too narrow an opening, most likely."""
FINENESS = {"fluid": ("particle_radius", 0.5), "soft": ("cell_size", float(PARTICLES_PER_CELL_EDGE))}
"""The key that says how fine a kind is, and its value over the distance of particles."""


def check_opening(
    job: Job,
    path: KeyPath,
    opening: Opening,
    earlier: Mapping[KeyPath, Opening],
    solids: Solids,
    *,
    findings: Findings,
) -> bool:
    """Note what is wrong with an emitter of a path, beside earlier ones; returns whether its opening can be there."""
    obstacles = [solid for place, solid in solids.items() if place[0] in ("rigid", "soft")]
    others = {format_path(place): other for place, other in earlier.items()}
    reason = opening_problem(opening, _body(job, path).spacing, job.domain, obstacles, others)
    if reason:
        findings.error(path, reason)
    if opening.start_s >= job.film_s:
        findings.warn((*path, "start_s"), f"starts at {opening.start_s:g} s, after the film's end at {job.film_s:g} s")
    elif opening.inflow.travel_at(job.film_s) == 0.0:
        findings.warn((*path, "ramp"), f"is 0 whenever it emits in the film's {job.film_s:g} s: it emits nothing")
    _check_amount(job, path, opening, findings)
    return reason is None


def _body(job: Job, path: KeyPath) -> FluidParameters | SoftParameters:
    return job.fluid[int(path[1])] if path[0] == "fluid" else job.soft[int(path[1])]


def _check_amount(job: Job, path: KeyPath, opening: Opening, findings: Findings) -> None:
    """Refuse an amount of less than a particle, and warn of a rate that takes a jet too fast for the scene."""
    body = _body(job, path)
    emitter = body.emitter[int(path[3])]
    if opening.speed > 0.0 and opening.total_particles == 0.0:
        key = "end_s" if emitter.total_volume is None else "total_volume"
        volume, (finer, in_spacings) = opening.inflow.total_travel * emitter.area, FINENESS[str(path[0])]
        findings.error(
            (*path, key),
            f"makes {volume:.2g} m³ in all, less than half a particle of {body.spacing**3:.2g} m³: it emits nothing; "
            f"use more, or {finer} {rounded_down(in_spacings * (2.0 * volume) ** (1.0 / 3.0)):g} m",
        )
    sane = math.dist(job.domain.min, job.domain.max) * job.fps / FEWEST_FRAMES_ACROSS
    if emitter.flow_rate is not None and emitter.inflow_speed > sane:
        findings.warn(
            (*path, "flow_rate"),
            f"{emitter.flow_rate:g} m³/s through {emitter.area:.2g} m² is a jet of {emitter.inflow_speed:.3g} m/s, "
            f"which crosses the domain within {FEWEST_FRAMES_ACROSS} frames; use an opening of "
            f"{rounded_up(emitter.flow_rate / sane):g} m², or {rounded_down(sane * emitter.area):g} m³/s",
        )


def check_speeds(job: Job, path: KeyPath, findings: Findings) -> None:
    """Warn of starts so fast that particles cross the domain within a frame: a slip of the unit, most likely."""
    fastest = math.dist(job.domain.min, job.domain.max) * job.fps
    body = _body(job, path)
    speeds = [(("block", number, "velocity"), math.hypot(*block.velocity)) for number, block in enumerate(body.block)]
    speeds += [
        (("emitter", number, "speed"), emitter.speed)
        for number, emitter in enumerate(body.emitter)
        if emitter.speed is not None
    ]
    for key, speed in speeds:
        if speed > fastest:
            findings.warn(
                (*path, *key),
                f"{speed:g} m/s crosses the whole domain within a frame; the time steps will be very short",
            )
