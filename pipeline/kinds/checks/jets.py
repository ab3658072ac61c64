"""Checks of jets: against obstacles right before an emitter, or into the nozzle of another one.

A jet is followed as its middle flies, straight through its nozzle and on a parabola from there, up to the first thing
that it meets: what becomes of it then nobody can tell without the simulation. Bodies and blocks stand where they start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.model.boxes import Box, touch
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path
from sim.fluid.nozzles import is_same_nozzle

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.core.domain import DomainParameters
    from sim.fluid.opening import Opening
    from sim.shapes import Solid

Points = NDArray[np.float64]

MOST_STEPS = 4000
"""Points of a jet that are looked at; in a domain more than so many spacings across they are farther apart."""
MOST_BLOCKED = 0.5
"""Share of a jet's cross-section that may have something right before it."""


@dataclass(frozen=True)
class _Way:
    """How the middle of a jet flies until it meets something: points [m], (k, 3), and when it is there [s], (k,)."""

    points: Points
    times: NDArray[np.float64]


def check_jets(
    job: Job, solids: Mapping[KeyPath, Solid], openings: Mapping[KeyPath, Opening], spacing: float, findings: Findings
) -> None:
    """Warn of jets that cannot get away from their opening, and of those that run into another nozzle.

    Args:
        job: the job.
        solids: its bodies and blocks as far as they can be built, by path.
        openings: of its emitters, by path.
        spacing: of the particles [m].
        findings: where warnings go.
    """
    bodies = [solid for path, solid in solids.items() if path[0] == "rigid"]
    blocks = [solid for path, solid in solids.items() if path[0] == "fluid"]
    for path, opening in openings.items():
        needed = _room_needed(opening)
        room = _room_before(opening, job.domain, bodies, needed, spacing)
        if room < needed:
            findings.warn(
                path,
                f"a wall or body is {max(room, 0.0):.2g} m before its opening, where the flow needs {needed:.2g} m to "
                "get away; particles will be squeezed, and their places be taken: move or turn it",
            )
            continue
        way = _fly(job, opening, [*bodies, *blocks], spacing)
        for other_path, other in openings.items():
            if is_same_nozzle(opening, other, spacing):
                continue
            arrival = _arrival(way, opening, other, spacing)
            if arrival is not None:
                findings.warn(
                    path,
                    f"its jet runs into the nozzle of {format_path(other_path)} {arrival:.2g} s after it has begun; "
                    "what flows there gives way to nothing, so particles will be squeezed: move or turn one of them",
                )


def _room_needed(opening: Opening) -> float:
    """How far a wall has to be from an opening for the flow to get away sideways no faster than it comes [m].

    Beyond the nozzle the way out around the jet, perimeter times distance, has to be as large as its cross-section.
    """
    first, second = opening.half_size
    across = 0.5 * first if opening.is_round else first * second / (first + second)
    return opening.nozzle_depth + across


def _room_before(
    opening: Opening, domain: DomainParameters, bodies: Sequence[Solid], needed: float, spacing: float
) -> float:
    """How far most of a jet gets straight ahead [m], as far as it is needed."""
    # The particles of a layer are half a layer ahead of the opening.
    ahead = np.append(np.arange(0.5 * opening.layer_distance, needed, 0.5 * spacing), needed)
    shifts = (ahead - 0.5 * opening.layer_distance)[:, None, None] * opening.direction
    points = (opening.points[None] + shifts).reshape(-1, 3)
    blocked = _beyond_walls(points, domain)
    for solid in bodies:
        if touch(solid.bounds, _box_around(points), margin=0.0):
            blocked |= solid.signed_distance(points) < 0.0
    share = np.maximum.accumulate(blocked.reshape(len(ahead), -1), axis=0).mean(axis=1)
    reached = np.flatnonzero(share > MOST_BLOCKED)
    return float(ahead[reached[0]]) if len(reached) else needed


def _fly(job: Job, opening: Opening, obstacles: Sequence[Solid], spacing: float) -> _Way:
    """The way of a jet's middle until it meets a wall, a body or a block, leaves the domain, or the film ends."""
    gravity = np.asarray(job.gravity, dtype=np.float64)
    strength = float(np.linalg.norm(gravity))
    corners = np.array(list(product(*zip(job.domain.min, job.domain.max, strict=True))))
    farthest = opening.nozzle_depth + float(np.linalg.norm(corners - opening.centre, axis=1).max())
    driven_s = opening.nozzle_depth / opening.speed
    end_s = min(
        driven_s + _longest_flight(opening.speed, strength, farthest), job.frame_count / job.fps - opening.start_s
    )
    if end_s <= 0.0:
        return _Way(np.zeros((0, 3)), np.zeros(0))
    fastest = opening.speed + strength * end_s
    steps = min(MOST_STEPS, math.ceil(end_s * fastest / (0.5 * spacing)))
    times = np.linspace(0.0, end_s, steps + 1)
    flown = np.maximum(times - driven_s, 0.0)[:, None]
    points = opening.centre + times[:, None] * opening.velocity + 0.5 * flown**2 * gravity
    inside = _until_first(((points < job.domain.min) | (points > job.domain.max)).any(axis=1))
    points, times = points[:inside], times[:inside]
    stopped = np.zeros(inside, dtype=bool)
    for solid in obstacles:
        if inside and touch(solid.bounds, _box_around(points), margin=0.0):
            # What it comes out of is not in its way: blocks around a nozzle are pushed aside.
            stopped |= (solid.signed_distance(points) < 0.0) & (times > driven_s)
    kept = _until_first(stopped)
    return _Way(points[:kept], times[:kept])


def _longest_flight(speed: float, gravity: float, distance: float) -> float:
    """By when what is thrown has been so far away from where it began, whatever its direction [s].

    After t it is at least |v t - g t²/2| away, which is exact straight up. There, fast enough, it gets that far
    before it turns, v²/2g above; else it has to fall back past its start.

    Args:
        speed: at first [m/s].
        gravity: its strength [m/s²].
        distance: how far [m].
    """
    if gravity == 0.0:
        return distance / speed
    turning = speed**2 - 2.0 * gravity * distance
    if turning >= 0.0:
        # (v - sqrt(v² - 2 g D)) / g, without the difference of nearly equal numbers where gravity is weak.
        return 2.0 * distance / (speed + math.sqrt(turning))
    return (speed + math.sqrt(speed**2 + 2.0 * gravity * distance)) / gravity


def _arrival(way: _Way, opening: Opening, other: Opening, spacing: float) -> float | None:
    """When the core of a jet comes into another nozzle or its pipe [s], or None."""
    if not len(way.points):
        return None
    nozzle = cKDTree(np.concatenate([other.nozzle_places(), other.pipe(spacing)]))
    distance, _ = nozzle.query(way.points)
    near = np.flatnonzero(distance < min(opening.half_size))
    return float(way.times[near[0]]) if len(near) else None


def _box_around(points: Points) -> Box:
    """Bounds of at least one point."""
    return np.array([points.min(axis=0), points.max(axis=0)])


def _until_first(flags: NDArray[np.bool_]) -> int:
    """How many there are before the first that is true."""
    return int(np.argmax(flags)) if flags.any() else len(flags)


def _beyond_walls(points: Points, domain: DomainParameters) -> NDArray[np.bool_]:
    """Points outside of the domain's closed faces, (n,)."""
    beyond = np.zeros(len(points), dtype=bool)
    for axis, name in enumerate("xyz"):
        if f"{name}-" not in domain.open_faces:
            beyond |= points[:, axis] < domain.min[axis]
        if f"{name}+" not in domain.open_faces:
            beyond |= points[:, axis] > domain.max[axis]
    return beyond
