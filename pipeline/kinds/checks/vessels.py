"""Checks of vessels that emitters fill: a domain with walls all around, and bodies with a cavity under a jet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.jets import fly
from pipeline.model.amounts import rounded_down
from pipeline.model.boxes import domain_box, overlap
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path
from sim.fluid.opening import Opening
from sim.shapes.parameters import BoxShape, CapsuleShape, ConeShape, CylinderShape, SphereShape
from sim.shapes.placement import PlacedSolid

CELLS_ALONG_A_VESSEL = 48  # along the longest edge of a body whose cavity is measured
CONVEX = (BoxShape, SphereShape, CylinderShape, CapsuleShape, ConeShape)
BRIM = 0.02  # share by which a vessel may be overfull: its volume is measured in cells


def check_vessels(job: Job, solids: Solids, openings: Mapping[KeyPath, Opening], findings: Findings) -> None:
    """Warn of emitters that bring more than a domain with walls, or a body with a cavity under them, can hold."""
    _check_domain(job, solids, openings, findings)
    poured: dict[KeyPath, list[KeyPath]] = {}
    for path, opening in openings.items():
        vessel = None if opening.moves else _vessel_under(job, opening, solids)
        if vessel is not None:
            poured.setdefault(vessel, []).append(path)
    for vessel, paths in poured.items():
        _check_vessel(job, vessel, paths, solids, findings)


def _check_domain(job: Job, solids: Solids, openings: Mapping[KeyPath, Opening], findings: Findings) -> None:
    if not set(job.domain.open_faces) <= {"z+"}:
        return
    box = domain_box(job.domain)
    room = math.prod((box[1] - box[0]).tolist())
    room -= sum(solid.volume * overlap(solid.bounds, box) for place, solid in solids.items() if place[0] == "rigid")
    filled = sum(solid.volume * overlap(solid.bounds, box) for place, solid in solids.items() if place[0] == "fluid")
    way_out = "or it runs over the open top" if job.domain.open_faces else "or open a face"
    earlier: list[KeyPath] = []
    for path in openings:
        earlier.append(path)
        inside = filled + _poured(job, earlier)
        if inside > room:
            findings.warn(
                path,
                f"overfills the domain: with it {inside:.3g} m³ are in by {job.film_s:g} s, and there is room for "
                f"{room:.3g} m³; {_remedy(job, path, inside - room)}, {way_out}",
            )


def _check_vessel(job: Job, vessel: KeyPath, paths: list[KeyPath], solids: Solids, findings: Findings) -> None:
    room, low, high = _cavity(solids[vessel])
    inside = np.stack([low, high])
    filled = sum(
        each.volume * overlap(each.bounds, inside) for place, each in solids.items() if place[0] == "fluid"
    ) + _poured(job, paths)
    if filled > (1.0 + BRIM) * room:
        path = paths[-1]
        findings.warn(
            path,
            f"overfills {format_path(vessel)}: {1000.0 * filled:.3g} l come in by {job.film_s:g} s, and it holds "
            f"{1000.0 * room:.3g} l up to its rim; {_remedy(job, path, filled - room)}",
        )


def _poured(job: Job, paths: Sequence[KeyPath]) -> float:
    """Volume that emitters bring in the film [m³], of each fluid its cap at most."""
    volumes = dict.fromkeys((int(path[1]) for path in paths), 0.0)
    for path in paths:
        volumes[int(path[1])] += job.fluid[int(path[1])].emitter[int(path[3])].emitted_volume(job.film_s)
    return sum(min(volume, job.fluid[index].most_volume) for index, volume in volumes.items())


def _remedy(job: Job, path: KeyPath, excess: float) -> str:
    left = _poured(job, [path]) - excess
    return f"use total_volume = {rounded_down(left):g}" if left > 0.0 else "leave it out"


def _vessel_under(job: Job, opening: Opening, solids: Solids) -> KeyPath | None:
    """The body that stands still and into whose cavity a jet falls first, or None."""
    if opening.speed == 0.0:
        return None
    points, _ = fly(job, opening, [], job.fluid[0].spacing)
    found: list[tuple[int, KeyPath]] = []
    for index, body in enumerate(job.rigid):
        solid = solids.get(("rigid", index))
        if body.kind != "static" or solid is None or isinstance(body.shape, CONVEX):
            continue
        within = ((points >= solid.bounds[0]) & (points <= solid.bounds[1])).all(axis=1)
        if not within.any():
            continue
        room, low, high = _cavity(solid)
        within = ((points >= low) & (points <= high)).all(axis=1)
        if room > 0.0 and within.any():
            found.append((int(np.argmax(within)), ("rigid", index)))
    return min(found)[1] if found else None


@lru_cache(maxsize=16)
def _cavity(solid: PlacedSolid) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Volume that stays in a body [m³] when it is filled to the brim from above, and the corners of a box around that.

    A cell of air is filled unless there is a way out of it, through cells that are no higher.
    """
    from scipy.ndimage import label

    low, high = solid.bounds
    cell = float((high - low).max()) / CELLS_ALONG_A_VESSEL
    counts = np.ceil((high - low) / cell).astype(int)
    axes = [start + (np.arange(-1, n + 1) + 0.5) * cell for start, n in zip(low, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    air = (solid.signed_distance(points.reshape(-1, 3)) > 0.0).reshape(points.shape[:3])
    filled = np.zeros_like(air)
    for level in range(1, air.shape[2] - 1):
        pieces, _ = label(air[:, :, : level + 1])
        outside = pieces[0, 0, 0]  # the layer around the body is air, and one piece
        filled[:, :, level] = air[:, :, level] & (pieces[:, :, level] != outside)
    if not filled.any():
        return 0.0, low, low
    held = points[filled]
    return float(filled.sum()) * cell**3, held.min(axis=0) - 0.5 * cell, held.max(axis=0) + 0.5 * cell
