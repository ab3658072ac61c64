"""Checks of smoke: memory, air to move in, and sources."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.checks.closed_domain import check_shut_in_air
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.checks.smoke_bodies import LEAST_LAYERS, check_bodies_in_smoke
from pipeline.model.amounts import count, gigabytes, rounded_down, rounded_up
from pipeline.model.boxes import Box, overlap, smoke_box, span, touch
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path, suggestion
from sim.smoke.parameters import CELLS_PER_EDDY, MOST_CELLS, SmokeParameters, SmokeSourceParameters

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.shapes import PlacedSolid, Solid

BYTES_PER_CELL, BYTES_PER_CELL_ON_GPU = 320, 250
"""Upper bounds of what a smoke takes: 171 for the solver and all that it may be coupled to (101 for itself and what
moves in it, multigrid levels included, 32 for fluid, 24 for cloth, 14 for turbulence), and where a CPU computes 144 on
top for the six snapshots and checkpoints that the simulation may hold at once. On a GPU these are not in its memory."""
BYTES_PER_ROW_ON_GPU = 5 * 32 * 8
"""On top for each row of cells along z: five reductions (`sim.smoke.reductions`) of 32 lanes, two numbers each. Boxes
of few cells along z take more for these than for their cells. A CPU has one lane a row, within the bound above."""
ALL = 1.0 - 1e-6
"""Share of a box that counts as all of it: sizes and positions written in decimal do not add up exactly."""
COUNTED_CELLS = 1_000_000
"""A source whose box has more cells than this is taken to have some of its own; in a larger box of smoke nobody looks
for air that bodies shut in."""
HOTTEST = 10_000.0
"""Hotter gas is a plasma, which neither these equations nor a film's light describe [K]."""
HOTTEST_FLAME = 4_000.0
"""The hottest flames in air or oxygen have 3,000 to 3,500 K; wood burns at 1,300 to 1,600 K [K]."""
COLDEST_AIR = 150.0
"""Numbers below are degrees Celsius, most likely; the coldest air on earth has 184 K [K]."""
GONE = 0.01
"""Part of smoke or heat that counts as nothing."""
SMALLEST_TOLERANCE = 2.0e-7
"""Divergence that single precision can be rid of, over the largest speed and times the cell [-]: a plume of 32³ cells
came to 1.4e-7 to 0.7e-7 in 60 iterations a step."""


def check_smokes(job: Job, solids: Mapping[KeyPath, PlacedSolid], budget: MemoryBudget, findings: Findings) -> int:
    """Note what is wrong with the smokes, their sources and what moves in them.

    Args:
        job: the job.
        solids: its shapes as far as they can be built, where they start, by path.
        budget: of the machine that simulates.
        findings: where errors and warnings go.

    Returns:
        Cells of all smokes.
    """
    names = {body.name for body in job.rigid}
    cells, size_bytes = 0, 0.0
    refused = check_bodies_in_smoke(job, solids, findings)
    solids = {path: solid for path, solid in solids.items() if path[0] != "rigid" or path[1] not in refused}
    for index, smoke in enumerate(job.smoke):
        more_cells, more_bytes = _check_size(job, index, budget, (cells, size_bytes), findings)
        cells, size_bytes = cells + more_cells, size_bytes + more_bytes
        _check_air(job, smoke, index, solids, findings)
        check_shut_in_air(job, smoke, solids, findings)
        for number, source in enumerate(smoke.source):
            path: KeyPath = ("smoke", index, "source", number)
            _check_numbers(job, smoke, source, path, findings)
            _check_following(job, source, path, findings)
            # Where one is whose body is not known nobody can tell.
            if path in solids and (source.follow is None or source.follow in names):
                _check_place(job, index, number, solids, findings)
    return cells


# --- the grid ------------------------------------------------------------------------------------------------------


def _check_size(
    job: Job, index: int, budget: MemoryBudget, before: tuple[int, float], findings: Findings
) -> tuple[int, float]:
    """Cells and bytes of the smoke's grid, which comes after so many of others."""
    smoke = job.smoke[index]
    box = smoke_box(smoke, job.domain)
    extent = box[1] - box[0]
    if np.any(extent <= 0.0):
        corner = "max" if smoke.max is not None else "min"
        findings.error(("smoke", index, corner), f"max must be above min on every axis, got {span(box)}")
        return 0, 0.0
    if np.any(extent < LEAST_LAYERS * smoke.cell_size):
        findings.error(
            ("smoke", index, "cell_size"),
            f"{smoke.cell_size:g} m leaves fewer than {LEAST_LAYERS:g} cells along an edge of {extent.min():.3g} m; "
            f"use {rounded_down(extent.min() / LEAST_LAYERS):g} m or less",
        )
    layers = np.ceil(extent / smoke.cell_size)
    cells, size_bytes = float(np.prod(layers)), _bytes_of(layers, on_gpu=budget.on_gpu)
    cells_before, bytes_before = before
    if size_bytes + bytes_before > budget.bytes:
        room = max(0.0, budget.bytes - bytes_before)
        size = _cell_size_that_fits(extent, smoke.cell_size, room, on_gpu=budget.on_gpu)
        beside = f" beside the {count(cells_before)} of other smoke" if cells_before else ""
        findings.error(
            ("smoke", index, "cell_size"),
            f"{count(cells)} cells need {gigabytes(size_bytes)}, "
            f"{budget.owner} has {gigabytes(budget.bytes)}; "
            f"at most {count(room // (size_bytes / cells))} fit{beside}: use {rounded_up(size):g} m or more",
        )
    elif cells > MOST_CELLS:
        size = _cell_size_that_fits(extent, smoke.cell_size, float(MOST_CELLS * BYTES_PER_CELL), on_gpu=False)
        findings.error(
            ("smoke", index, "cell_size"),
            f"{count(cells)} cells are more than a smoke may have, {count(MOST_CELLS)}; "
            f"use {rounded_up(size):g} m or more",
        )
    return int(cells), size_bytes


def _bytes_of(layers: NDArray[np.float64], *, on_gpu: bool) -> float:
    """Upper bound of the memory of a box of so many cells along x, y, z."""
    rows = float(layers[0] * layers[1])
    cells = float(np.prod(layers))
    return cells * BYTES_PER_CELL_ON_GPU + rows * BYTES_PER_ROW_ON_GPU if on_gpu else cells * BYTES_PER_CELL


def _cell_size_that_fits(extent: NDArray[np.float64], cell_size: float, room: float, *, on_gpu: bool) -> float:
    """The smallest cell size [m], not below a given one, that cuts a box into cells of so many bytes, or into one."""
    most = max(1.0, room // (BYTES_PER_CELL_ON_GPU if on_gpu else BYTES_PER_CELL))
    size = max(cell_size, float(np.cbrt(np.prod(extent) / most)))
    layers = np.ceil(extent / size)
    while _bytes_of(layers, on_gpu=on_gpu) > room and layers.max() > 1.0:
        # Counts are rounded up: the next size of use is the one that saves a layer of cells.
        size = float(np.min(extent[layers > 1.0] / (layers[layers > 1.0] - 1.0))) * (1.0 + 1.0e-9)
        layers = np.ceil(extent / size)
    return size


def _check_way_out(
    job: Job, smoke: SmokeParameters, path: KeyPath, solids: Mapping[KeyPath, Solid], findings: Findings
) -> None:
    """Note wind into air that static bodies shut in; of a large grid the simulation tells it when it starts."""
    from sim.smoke.grid import SmokeGrid

    bodies = [
        solids["rigid", index] for index, body in enumerate(job.rigid)
        if body.kind == "static" and ("rigid", index) in solids
    ]  # fmt: skip
    low, high = smoke_box(smoke, job.domain)
    is_too_large = math.prod(np.ceil((high - low) / smoke.cell_size).tolist()) > COUNTED_CELLS
    if not (smoke.windward_faces and bodies) or np.any(high <= low) or is_too_large:
        return
    try:
        grid = SmokeGrid.build(smoke, job.domain, bodies)
    except ValueError as error:
        # Its message begins with the smoke's name, which the path says as well.
        findings.error(path, str(error).removeprefix(f'smoke "{smoke.name}": '))
        return
    if cut_off := grid.cut_off_faces():
        findings.error((*path, "wind"), smoke.cut_off_problem(cut_off))


def _check_air(
    job: Job, smoke: SmokeParameters, index: int, solids: Mapping[KeyPath, Solid], findings: Findings
) -> None:
    """Wind, gusts, gravity and what air does to smoke."""
    path: KeyPath = ("smoke", index)
    if problem := smoke.wind_problem():
        findings.error((*path, "wind"), problem)
    else:
        _check_way_out(job, smoke, path, solids, findings)
    gusts = smoke.turbulence
    smallest = CELLS_PER_EDDY * smoke.cell_size
    if gusts.strength > 0.0 and gusts.size < smallest * (1.0 - 1.0e-9):
        findings.error(
            (*path, "turbulence", "size"),
            f"{gusts.size:g} m is less than two cells of {smoke.cell_size:g} m, which carry no such eddies; "
            f"use {rounded_up(smallest * (1.0 - 1.0e-9)):g} m or more",
        )
    blown = any(smoke.wind) or gusts.strength > 0.0
    driven = any(source.velocity is not None for source in smoke.source)
    pushed = job.fluid or any(body.kind != "static" for body in job.rigid)
    if not (any(job.gravity) or blown or driven or pushed):
        findings.warn(
            ("gravity",),
            f'is zero, so heat and weight do not move smoke "{smoke.name}", and nothing else does: it stays where '
            "it comes from; give its source a velocity, or the smoke wind",
        )
    frame_s, most = 1.0 / job.fps, -math.log(GONE) * job.fps
    for key, fate in (("density_dissipation", "no smoke is to be seen"), ("cooling", "no heat is left to rise")):
        if (rate := getattr(smoke, key)) > most:
            findings.warn(
                (*path, key),
                f"{rate:g} 1/s leaves {100.0 * GONE:g} % after {-math.log(GONE) / rate:.2g} s, less than a frame of "
                f"{frame_s:.2g} s: {fate}; use well below {most:.2g} 1/s",
            )
    if smoke.projection_tolerance < SMALLEST_TOLERANCE:
        findings.warn(
            (*path, "projection_tolerance"),
            f"{smoke.projection_tolerance:g} is below what single precision reaches, about {SMALLEST_TOLERANCE:g}: "
            "solves will hit their iteration limit",
        )
    ambient = smoke.ambient_temperature
    if not COLDEST_AIR <= ambient <= HOTTEST_FLAME:
        findings.warn((*path, "ambient_temperature"), f"{ambient:g} K is no air; 20 °C are 293 K")


# --- sources -------------------------------------------------------------------------------------------------------


def _check_numbers(
    job: Job, smoke: SmokeParameters, source: SmokeSourceParameters, path: KeyPath, findings: Findings
) -> None:
    kelvin = source.temperature
    if kelvin > HOTTEST:
        findings.error(
            (*path, "temperature"), f"{kelvin:g} K is beyond {HOTTEST:g} K, where gas is a plasma; flames have 1500 K"
        )
    elif kelvin > HOTTEST_FLAME:
        findings.warn((*path, "temperature"), f"{kelvin:g} K is hotter than any flame; wood burns at 1500 K")
    elif kelvin < COLDEST_AIR:
        findings.warn((*path, "temperature"), f"{kelvin:g} K is colder than any air; 20 °C are 293 K")
    is_empty = source.density == 0.0 and kelvin == smoke.ambient_temperature
    if is_empty and source.velocity is None:
        findings.warn(path, "has no density, and the temperature of the air: it emits nothing")
    film_s = job.frame_count / job.fps
    emits = source.emits_during(0.0, film_s)
    if emits and source.largest_strength(*source.span_of(0.0, film_s)) == 0.0:
        findings.warn((*path, "ramp"), f"is 0 whenever it emits in the film's {film_s:g} s: it emits nothing")


def _check_following(job: Job, source: SmokeSourceParameters, path: KeyPath, findings: Findings) -> None:
    names = [body.name for body in job.rigid]
    if source.follow is not None and source.follow not in names:
        hint = suggestion(source.follow, names) or (f"; bodies are {', '.join(names)}" if names else "; add [[rigid]]")
        findings.error((*path, "follow"), f'no rigid body is named "{source.follow}"{hint}')


def _check_place(job: Job, index: int, number: int, solids: Mapping[KeyPath, Solid], findings: Findings) -> None:
    path: KeyPath = ("smoke", index, "source", number)
    smoke, source, solid = job.smoke[index], job.smoke[index].source[number], solids[path]
    body = next((each for each in job.rigid if each.name == source.follow), None)
    box = smoke_box(smoke, job.domain)
    if body is not None and body.kind == "dynamic":
        pass  # nobody knows where it gets
    elif source.keyframe or (body is not None and body.kind == "kinematic"):
        _check_way(job, path, solid, box, findings)
    else:
        _check_source(job, path, solids, box, findings)
    if source.moves and np.min(solid.bounds[1] - solid.bounds[0]) < smoke.cell_size:
        findings.warn(path, f"is thinner than a cell of {smoke.cell_size:g} m and may emit nothing; enlarge it")
    _check_what_fills_source(job, path, solid, solids, findings)


def _check_source(job: Job, path: KeyPath, solids: Mapping[KeyPath, Solid], box: Box, findings: Findings) -> None:
    """A source that stays: is it in the box, and which cells are its own?"""
    solid, cell_size = solids[path], job.smoke[int(path[1])].cell_size
    inside = overlap(solid.bounds, box)
    if inside == 0.0:
        findings.error(path, f"is wholly outside the smoke's grid: it spans {span(solid.bounds)}, not {span(box)}")
        return
    if inside < ALL:
        findings.warn(path, f"{100 * (1 - inside):.0f} % of it are outside the smoke's grid and emit nothing")
    centres = centres_inside(solid, box, cell_size)
    if centres is None:
        return
    if len(centres) == 0:
        thinnest = float(np.min(solid.bounds[1] - solid.bounds[0]))
        findings.error(
            path,
            f"holds no centre of a cell: it is {thinnest:.3g} m thin, and cells are {cell_size:g} m; "
            "enlarge it or use a smaller cell_size",
        )
        return
    if not are_free(job, centres, solid, solids).any():
        findings.error(path, "lies wholly inside solid bodies, so it emits nothing; move it")


def are_free(
    job: Job, centres: NDArray[np.float64], source: Solid, solids: Mapping[KeyPath, Solid]
) -> NDArray[np.bool_]:
    """Mask of the centres of cells [m], (n, 3), in a source that lie outside every static body, (n,) bool."""
    is_free = np.ones(len(centres), bool)
    for path, body in solids.items():
        if path[0] == "rigid" and job.rigid[int(path[1])].kind == "static":
            near = touch(body.bounds, source.bounds, margin=0.0)
            is_free &= body.signed_distance(centres) >= 0.0 if near else True
    return is_free


def centres_inside(solid: Solid, box: Box, cell_size: float) -> NDArray[np.float64] | None:
    """Centres of cells that a solid contains [m], (n, 3); None if they are too many to look at each."""
    low = np.maximum(solid.bounds[0], box[0])
    high = np.minimum(solid.bounds[1], box[1])
    first = np.ceil((low - box[0]) / cell_size - 0.5)
    last = np.floor((high - box[0]) / cell_size - 0.5)
    if np.prod(np.maximum(last - first + 1.0, 0.0)) > COUNTED_CELLS:
        return None
    axes = [
        corner + (np.arange(a, b + 1.0) + 0.5) * cell_size for corner, a, b in zip(box[0], first, last, strict=True)
    ]
    centres: NDArray[np.float64] = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if len(centres) == 0:
        return centres
    inside: NDArray[np.bool_] = solid.signed_distance(centres) < 0.0
    return centres[inside]


def _check_way(job: Job, path: KeyPath, solid: Solid, box: Box, findings: Findings) -> None:
    """A source on a path: does that come into the box?"""
    from sim.core.motion.paths import path_through
    from sim.rigid.paths import path_of

    source = job.smoke[int(path[1])].source[int(path[3])]
    reach = float(np.linalg.norm(solid.bounds[1] - solid.bounds[0]))
    if source.keyframe:
        low, high = path_through(source.keyframe, linear=source.interpolation == "linear").hull()
    else:
        low, high = path_of(next(body for body in job.rigid if body.name == source.follow)).hull()
        reach += math.hypot(*source.position)
    way = np.stack([low - reach, high + reach])
    if not touch(way, box, margin=0.0):
        findings.error(path, f"never comes into the smoke's grid: its way spans {span(way)}, not {span(box)}")


def _check_what_fills_source(
    job: Job, path: KeyPath, source: Solid, solids: Mapping[KeyPath, Solid], findings: Findings
) -> None:
    """Note a source wholly within water or a body that moves, as far as the corners of its box tell."""
    corners = np.array(np.meshgrid(*source.bounds.T)).reshape(3, 8).T
    followed = job.smoke[int(path[1])].source[int(path[3])].follow
    for other, solid in solids.items():
        body = job.rigid[int(other[1])] if other[0] == "rigid" else None
        is_own = body is not None and body.name == followed
        is_mover = body is not None and body.kind != "static"
        if not (is_own or is_mover or other[0] == "fluid") or not touch(solid.bounds, source.bounds, margin=0.0):
            continue
        if not (solid.signed_distance(corners) < 0.0).all():
            continue
        if is_own:
            findings.error(
                path, f"lies wholly inside {format_path(other)}, which it follows: it emits nothing; move it"
            )
        else:
            findings.warn(
                path,
                f"lies wholly inside {format_path(other)} at the start, and emits nothing until that has moved off",
            )
