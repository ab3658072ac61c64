"""Checks of jets: against obstacles right before an emitter, or into the opening of another one.

A jet is followed as its middle flies, on a parabola, up to the first thing that it meets: what becomes of it then
nobody can tell without the simulation. Bodies and blocks stand where they start; openings that move are not looked at.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.kinds.base import Solids
from pipeline.model.boxes import Box, touch
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path
from sim.core.domain import DomainParameters
from sim.fluid.opening import Opening
from sim.fluid.opening_conflicts import is_same_opening
from sim.shapes.solid import Solid

Points = NDArray[np.float64]
Times = NDArray[np.float64]

# Points of a jet that are looked at; in a domain more than so many spacings across they are farther apart.
MOST_STEPS = 4000
# Share of a jet's cross-section that may have something right before it.
MOST_BLOCKED = 0.5


def check_jets(
    job: Job, solids: Solids, openings: Mapping[KeyPath, Opening], spacing: float, findings: Findings
) -> None:
    """Warn of jets, of particles of a spacing [m], that cannot leave their opening or run into another one."""
    openings = {path: opening for path, opening in openings.items() if not opening.moves and opening.speed > 0.0}
    bodies = [solid for path, solid in solids.items() if path[0] == "rigid"]
    blocks = [solid for path, solid in solids.items() if path[0] in ("fluid", "soft")]
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
        flight = fly(job, opening, [*bodies, *blocks], spacing)
        for other_path, other in openings.items():
            if is_same_opening(opening, other, spacing):
                continue
            arrival = _arrival(*flight, opening, other)
            if arrival is not None:
                findings.warn(
                    path,
                    f"its jet runs into the opening of {format_path(other_path)} {arrival:.2g} s after it has begun, "
                    "and will take the places of what flows in there: move or turn one of them",
                )


def _room_needed(opening: Opening) -> float:
    """How far a wall has to be from an opening for the flow to get away sideways no faster than it comes [m].

    Beyond its first layer the way out around the jet, perimeter times distance, has to be as large as its section.
    """
    first, second = opening.half_size
    return opening.layer_distance + first * second / (first + second)


def _room_before(
    opening: Opening, domain: DomainParameters, bodies: Sequence[Solid], needed: float, spacing: float
) -> float:
    """How far most of a jet gets straight ahead [m], as far as it is needed."""
    # The particles of a layer are half a layer ahead of the opening.
    ahead = np.append(np.arange(0.5 * opening.layer_distance, needed, 0.5 * spacing), needed)
    shifts = (ahead - 0.5 * opening.layer_distance)[:, None, None] * opening.direction(opening.placement)
    points = (opening.points(1)[None] + shifts).reshape(-1, 3)
    blocked = _beyond_walls(points, domain)
    for solid in bodies:
        if touch(solid.bounds, _box_around(points), margin=0.0):
            blocked |= solid.signed_distance(points) < 0.0
    share = np.maximum.accumulate(blocked.reshape(len(ahead), -1), axis=0).mean(axis=1)
    reached = np.flatnonzero(share > MOST_BLOCKED)
    return float(ahead[reached[0]]) if len(reached) else needed


def fly(job: Job, opening: Opening, obstacles: Sequence[Solid], spacing: float) -> tuple[Points, Times]:
    """Path of a jet's middle until it meets a wall, a body or a block, leaves the domain, or the film ends.

    Returns:
        Points [m], (k, 3), and times [s], (k,).
    """
    gravity, out_s = np.asarray(job.gravity, dtype=np.float64), opening.layer_distance / opening.speed
    centre, velocity = opening.first_jet

    def places(times: Times) -> Points:
        flown = times[:, None]
        path: Points = centre + flown * velocity + 0.5 * flown**2 * gravity
        return path

    def are_outside(points: Points) -> NDArray[np.bool_]:
        outside: NDArray[np.bool_] = ((points < job.domain.min) | (points > job.domain.max)).any(axis=1)
        return outside

    film_s, end_s = job.film_s - opening.start_s, 2.0 * out_s
    while end_s < film_s and not are_outside(places(np.array([end_s])))[0]:
        end_s *= 2.0
    end_s = max(0.0, min(end_s, film_s))
    fastest = opening.speed + float(np.linalg.norm(gravity)) * end_s
    steps = min(MOST_STEPS, math.ceil(end_s * fastest / (0.5 * spacing)))
    times = np.linspace(0.0, end_s, steps + 1)
    points = places(times)
    inside = _until_first(are_outside(points))
    points, times = points[:inside], times[:inside]
    stopped = np.zeros(inside, dtype=bool)
    for solid in obstacles:
        if inside and touch(solid.bounds, _box_around(points), margin=0.0):
            # What it comes out of is not in its way: blocks around an opening are pushed aside.
            stopped |= (solid.signed_distance(points) < 0.0) & (times > out_s)
    kept = _until_first(stopped)
    return points[:kept], times[:kept]


def _arrival(points: Points, times: Times, opening: Opening, other: Opening) -> float | None:
    """When the core of a jet comes to another opening [s], or None."""
    if not len(points):
        return None
    distance, _ = cKDTree(other.points(1)).query(points)
    near = np.flatnonzero(distance < min(opening.half_size))
    return float(times[near[0]]) if len(near) else None


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
