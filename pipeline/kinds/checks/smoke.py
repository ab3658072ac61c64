"""Checks of smoke: memory, air to move in, and sources."""

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.closed_domain import check_closed_domain
from pipeline.kinds.checks.memory_budget import MemoryBudget, memory_budget
from pipeline.kinds.checks.smoke_bodies import (
    LEAST_LAYERS,
    GeometryBuilder,
    check_bodies_in_smoke,
    check_mesh_grids,
    geometry_builder,
    static_bodies,
)
from pipeline.kinds.sizes import expected_cells
from pipeline.kinds.work import guide_share
from pipeline.model.amounts import count, gigabytes, rounded_down, rounded_up
from pipeline.model.boxes import ALL, Box, overlap, smoke_box, span, touch
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, Problem, format_path, unknown_name
from sim.core.motion.paths import path_through
from sim.core.parameters import Vector3
from sim.rigid.paths import path_of
from sim.shapes.placement import PlacedSolid
from sim.shapes.solid import Solid
from sim.smoke.grid import SmokeGrid
from sim.smoke.parameters import CELLS_PER_EDDY, MOST_CELLS, SmokeParameters, SmokeSourceParameters

BYTES_PER_CELL, BYTES_PER_CELL_ON_GPU = 378, 250
"""Upper bounds: 219 for the solver and its couplings, and, where a CPU computes, 159 for the six snapshots and
checkpoints that the simulation may hold at once; on a GPU these are not in its memory."""
FIRE_BYTES, FIRE_BYTES_ON_GPU = 36, 8
"""On top for each cell where fuel burns: fuel and expansion, and fuel in checkpoints."""
BYTES_PER_ROW_ON_GPU = 5 * 32 * 8
"""On top for each row of cells along z: five reductions (`sim.smoke.reductions`) of 32 lanes, two numbers each."""
COUNTED_CELLS = 1_000_000
"""A source whose box has more cells than this is taken to have some of its own; in a larger box of smoke nobody looks
for air that bodies shut in."""
# Hotter gas is a plasma, which neither these equations nor a film's light describe [K].
HOTTEST = 10_000.0
# Flames in air or oxygen have 3,500 K at most; wood burns at 1,300 to 1,600 K [K].
HOTTEST_FLAME = 4_000.0
# Numbers below are degrees Celsius, most likely; the coldest air on earth has 184 K [K].
COLDEST_AIR = 150.0
# Part of smoke or heat that counts as nothing.
GONE = 0.01
SMALLEST_TOLERANCE = 2.0e-7
"""Divergence that single precision can be rid of, over the largest speed and times the cell [-]."""
COARSER_SIZES = 4
"""Cell sizes that are tried for a preview, from the largest down to the one that is written."""


def check_smokes(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    """Note what is wrong with the smokes, their sources and what moves in them; returns cells of all smokes."""
    cells, size_bytes = 0, 0.0
    geometry_of = geometry_builder(job, findings)
    for index, smoke in enumerate(job.smoke):
        more_cells, more_bytes = _check_size(job, index, budget, (cells, size_bytes), findings)
        cells, size_bytes = cells + more_cells, size_bytes + more_bytes
        if smoke.grid != "box":
            _check_first_window(job, index, solids, budget, findings)
        standing = _check_in_cells(job, index, solids, geometry_of, findings)
        if smoke.upres > 1:
            _check_guide(job, index, solids, geometry_of, findings)
        check_mesh_grids(job, smoke, solids, geometry_of, findings)
        _check_air(job, smoke, index, standing, findings)
        check_closed_domain(job, smoke, solids, findings)
        _check_fire(smoke, index, findings)
        for number, source in enumerate(smoke.source):
            path: KeyPath = ("smoke", index, "source", number)
            _check_numbers(job, smoke, source, path, findings)
            _check_following(job, source, path, findings)
    return cells


def coarser_cell_sizes(job: Job, largest_factor: float, solids: Solids) -> list[float]:
    """Cell sizes [m] of the smokes, grown by this factor at most, that lose no source and no body.

    Where cells as they are written are wrong already they are kept, so that problems are those of the written job. Of
    a smoke with a guide they are the guide's: what goes where in the film is as there.
    """
    geometry_of = geometry_builder(job, Findings())

    def problems(index: int, cell_size: float) -> Findings:
        smoke = job.smoke[index].model_copy(update={"cell_size": cell_size})
        return _problems_in_cells(job, index, smoke, solids, geometry_of)

    factors = np.linspace(largest_factor, 1.0, COARSER_SIZES, endpoint=False).tolist()
    cell_sizes = []
    for index, smoke in enumerate(job.smoke):
        if smoke.upres > 1:
            cell_sizes.append(smoke.guide.cell_size)
            continue
        low, high = smoke_box(smoke, job.domain)
        cell_sizes.append(smoke.cell_size)
        for cell_size in (smoke.cell_size * factor for factor in factors):
            if (high - low).min() < LEAST_LAYERS * cell_size or (found := problems(index, cell_size)).errors:
                continue
            known = problems(index, smoke.cell_size).warnings if found.warnings else []
            if Counter(each.path for each in found.warnings) <= Counter(each.path for each in known):
                cell_sizes[index] = cell_size
                break
    return cell_sizes


def _problems_in_cells(
    job: Job, index: int, smoke: SmokeParameters, solids: Solids, geometry_of: GeometryBuilder
) -> Findings:
    """Bodies and sources that the cells of another smoke in the place of one cannot show."""
    changed = job.model_copy(update={"smoke": (*job.smoke[:index], smoke, *job.smoke[index + 1 :])})
    findings = Findings()
    _check_in_cells(changed, index, solids, geometry_of, findings)
    return findings


def _check_guide(job: Job, index: int, solids: Solids, geometry_of: GeometryBuilder, findings: Findings) -> None:
    """Note what the cells of a guide cannot show, or what it costs."""
    smoke, guide, path = job.smoke[index], job.smoke[index].guide, ("smoke", index, "upres")
    low, high = smoke_box(smoke, job.domain)
    if (high - low).min() < LEAST_LAYERS * guide.cell_size:
        findings.error(
            path,
            f"{smoke.upres} leaves the guide fewer than {LEAST_LAYERS:g} cells of {guide.cell_size:g} m along an edge "
            f"of {(high - low).min():.3g} m; use less, or smaller cells",
        )
        return
    own = _problems_in_cells(job, index, smoke, solids, geometry_of)
    found = _problems_in_cells(job, index, guide, solids, geometry_of)
    for note, of_guide, of_smoke in (
        (findings.error, found.errors, own.errors),
        (findings.warn, found.warnings, own.warnings),
    ):
        known = {problem.path for problem in of_smoke}
        for problem in of_guide:
            if problem.path not in known:
                note(
                    path,
                    f"in the guide's cells of {guide.cell_size:g} m: {format_path(problem.path)} {problem.message}",
                )
    cells = count(expected_cells(guide, job.domain))
    findings.facts.append(
        Problem(
            path,
            f"{smoke.upres}: a simulation of {cells} cells of {guide.cell_size:g} m guides it, for "
            f"{100.0 * guide_share(smoke):.2g} % more time; --preview draws that one",
        )
    )


def _check_in_cells(
    job: Job, index: int, solids: Solids, geometry_of: GeometryBuilder, findings: Findings
) -> list[PlacedSolid]:
    """Note bodies and sources that the cells of a smoke cannot show; returns the static bodies that they can."""
    smoke = job.smoke[index]
    refused = check_bodies_in_smoke(job, smoke, solids, geometry_of, findings)
    standing = [solid for number, solid in static_bodies(job, solids).items() if number not in refused]
    names = {body.name for body in job.rigid}
    for number, source in enumerate(smoke.source):
        # The place of a source whose body is unknown is unknown too.
        path: KeyPath = ("smoke", index, "source", number)
        if path in solids and (source.follow is None or source.follow in names):
            _check_place(job, path, solids, standing, findings)
    return standing


# --- the grid ------------------------------------------------------------------------------------------------------


def _check_size(
    job: Job, index: int, budget: MemoryBudget, before: tuple[int, float], findings: Findings
) -> tuple[int, float]:
    """Cells and bytes of the smoke's grid; `before` are those of other smokes."""
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
    cells, size_bytes = float(np.prod(layers)), _bytes_of(layers, smoke, on_gpu=budget.on_gpu)
    cells_before, bytes_before = before
    if smoke.grid != "box":
        # Nobody knows how large its window gets: the job pauses should it outgrow the memory.
        return int(expected_cells(smoke, job.domain)), min(size_bytes, max(0.0, budget.bytes - bytes_before))
    if size_bytes + bytes_before > budget.bytes:
        room = max(0.0, budget.bytes - bytes_before)
        size = _cell_size_that_fits(extent, smoke, room, on_gpu=budget.on_gpu)
        beside = f" beside the {count(cells_before)} of other smoke" if cells_before else ""
        findings.error(
            ("smoke", index, "cell_size"),
            f"{count(cells)} cells need {gigabytes(size_bytes)}, "
            f"{budget.owner} has {gigabytes(budget.bytes)}; "
            f"at most {count(room // (size_bytes / cells))} fit{beside}: use {rounded_up(size):g} m or more",
        )
    elif cells > MOST_CELLS:
        size = _cell_size_that_fits(
            extent, smoke, float(MOST_CELLS * _bytes_per_cell(smoke, on_gpu=False)), on_gpu=False
        )
        findings.error(
            ("smoke", index, "cell_size"),
            f"{count(cells)} cells are more than a smoke may have, {count(MOST_CELLS)}; "
            f"use {rounded_up(size):g} m or more",
        )
    return int(cells), size_bytes


def _check_first_window(job: Job, index: int, solids: Solids, budget: MemoryBudget, findings: Findings) -> None:
    """Note sources, and bodies that its air pushes, that lie so far apart that no window around them fits."""
    smoke = job.smoke[index]
    paths: list[KeyPath] = [("smoke", index, "source", number) for number in range(len(smoke.source))]
    pushed = [("rigid", number) for number in _bodies_pushed(job, index)]
    paths += pushed
    bounds = [solids[path].bounds for path in paths if path in solids]
    if not bounds:
        return
    ends = np.clip([np.min(bounds, axis=0)[0], np.max(bounds, axis=0)[1]], *smoke.limits(job.domain))
    layers = np.ceil((ends[1] - ends[0]) / smoke.cell_size)
    size_bytes = _bytes_of(layers, smoke, on_gpu=budget.on_gpu)
    if size_bytes > budget.bytes:
        findings.error(
            ("smoke", index, "grid"),
            f"{count(float(np.prod(layers)))} cells lie in one window around all sources"
            f"{' and dynamic bodies' if pushed else ''}, and need {gigabytes(size_bytes)}; {budget.owner} has "
            f"{gigabytes(budget.bytes)}; give sources that are far apart a smoke each, "
            f"{'bodies far from them a smaller box of smoke, ' if pushed else ''}or use a larger cell_size",
        )


def _bodies_pushed(job: Job, index: int) -> list[int]:
    """Dynamic bodies, by number, that start in the box of a smoke, and of none before it."""
    *before, own = (np.array(smoke.limits(job.domain)) for smoke in job.smoke[: index + 1])

    def has(box: Box, place: Vector3) -> bool:
        return bool(np.all((box[0] <= place) & (place <= box[1])))

    return [
        number
        for number, body in enumerate(job.rigid)
        if body.kind == "dynamic" and has(own, body.position) and not any(has(box, body.position) for box in before)
    ]


def _bytes_of(layers: NDArray[np.float64], smoke: SmokeParameters, *, on_gpu: bool) -> float:
    """Upper bound of the memory of a box of so many cells along x, y, z."""
    rows = float(layers[0] * layers[1]) if on_gpu else 0.0
    return float(np.prod(layers)) * _bytes_per_cell(smoke, on_gpu=on_gpu) + rows * BYTES_PER_ROW_ON_GPU


def growth_refusal(job: Job) -> Callable[[float], str | None]:
    """A function that says why there is no memory, then, for so many more cells of smoke; None if there is."""

    def refusal(more: float) -> str | None:
        budget = memory_budget(job)
        each = max(_bytes_per_cell(smoke, on_gpu=budget.on_gpu) for smoke in job.smoke)
        return budget.refusal(more, "more", float(each))

    return refusal


def _bytes_per_cell(smoke: SmokeParameters, *, on_gpu: bool) -> int:
    """Of its own cells, with their share of a guide's."""
    of_all, of_fire = (BYTES_PER_CELL_ON_GPU, FIRE_BYTES_ON_GPU) if on_gpu else (BYTES_PER_CELL, FIRE_BYTES)
    each = of_all if smoke.fire is None else of_all + of_fire
    return each if smoke.upres == 1 else each + math.ceil(each / smoke.upres**3)


def _cell_size_that_fits(extent: NDArray[np.float64], smoke: SmokeParameters, room: float, *, on_gpu: bool) -> float:
    """The smallest cell size [m], not below the smoke's, that cuts a box into cells of so many bytes, or into one."""
    most = max(1.0, room // _bytes_per_cell(smoke, on_gpu=on_gpu))
    size = max(smoke.cell_size, float(np.cbrt(np.prod(extent) / most)))
    layers = np.ceil(extent / size)
    while _bytes_of(layers, smoke, on_gpu=on_gpu) > room and layers.max() > 1.0:
        # Counts are rounded up: the next size of use is the one that saves a layer of cells.
        size = float(np.min(extent[layers > 1.0] / (layers[layers > 1.0] - 1.0))) * (1.0 + 1.0e-9)
        layers = np.ceil(extent / size)
    return size


def _check_wind(job: Job, smoke: SmokeParameters, path: KeyPath, standing: Sequence[Solid], findings: Findings) -> None:
    """Note wind that has no way out of the box, or past static bodies; the latter in small grids only."""
    if problem := smoke.wind_problem():
        findings.error((*path, "wind"), problem)
        return
    if smoke.grid == "open":
        return
    low, high = smoke_box(smoke, job.domain)
    is_too_large = math.prod(np.ceil((high - low) / smoke.cell_size).tolist()) > COUNTED_CELLS
    if not (smoke.windward_faces and standing) or np.any(high <= low) or is_too_large:
        return
    try:
        grid = SmokeGrid.build(smoke, job.domain, standing)
    except ValueError as error:
        # Its message begins with the smoke's name, which the path says as well.
        findings.error(path, str(error).removeprefix(f'smoke "{smoke.name}": '))
        return
    if cut_off := grid.cut_off_faces():
        findings.error((*path, "wind"), smoke.cut_off_problem(cut_off))


def _check_air(job: Job, smoke: SmokeParameters, index: int, standing: Sequence[Solid], findings: Findings) -> None:
    """Wind, gusts, gravity and what air does to smoke."""
    path: KeyPath = ("smoke", index)
    _check_wind(job, smoke, path, standing, findings)
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
    pushed = job.fluid or job.soft or any(body.kind != "static" for body in job.rigid)
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
    is_empty = source.density == 0.0 and source.fuel == 0.0 and kelvin == smoke.ambient_temperature
    if is_empty and source.velocity is None:
        findings.warn(path, "has no density, and the temperature of the air: it emits nothing")
    if not source.emits_during(0.0, job.film_s):
        findings.warn((*path, "start_s"), f"starts at {source.start_s:g} s, after the film's end at {job.film_s:g} s")
    elif source.largest_strength(*source.span_of(0.0, job.film_s)) == 0.0:
        findings.warn((*path, "ramp"), f"is 0 whenever it emits in the film's {job.film_s:g} s: it emits nothing")


def _check_fire(smoke: SmokeParameters, index: int, findings: Findings) -> None:
    if smoke.fire is None:
        return
    path: KeyPath = ("smoke", index, "fire")
    hottest = smoke.ambient_temperature + smoke.hottest_excess
    if hottest > HOTTEST:
        findings.error((*path, "heat"), f"makes flames of {hottest:.0f} K, beyond {HOTTEST:g} K, where gas is a plasma")
    elif hottest > HOTTEST_FLAME:
        findings.warn((*path, "heat"), f"makes flames of {hottest:.0f} K, hotter than any; wood burns at 1500 K")
    if smoke.fire.soot == 0.0 and not any(source.density for source in smoke.source):
        findings.warn((*path, "soot"), "is 0, and no source has a density: nothing is there to glow or to be seen")


def _check_following(job: Job, source: SmokeSourceParameters, path: KeyPath, findings: Findings) -> None:
    names = [body.name for body in job.rigid]
    if source.follow is not None and source.follow not in names:
        problem = unknown_name(source.follow, names, "rigid body", plural="bodies", none="; add [[rigid]]")
        findings.error((*path, "follow"), problem)


def _check_place(job: Job, path: KeyPath, solids: Solids, standing: Sequence[Solid], findings: Findings) -> None:
    smoke, solid = job.smoke[int(path[1])], solids[path]
    source = smoke.source[int(path[3])]
    body = next((each for each in job.rigid if each.name == source.follow), None)
    box = np.array(smoke.limits(job.domain))
    if body is not None and body.kind == "dynamic":
        pass  # nobody knows where it gets
    elif source.keyframe or (body is not None and body.kind == "kinematic"):
        _check_path(job, path, solid, box, findings)
    else:
        _check_source(job, path, solid, standing, findings)
    if source.moves and np.min(solid.bounds[1] - solid.bounds[0]) < smoke.cell_size:
        findings.warn(path, f"is thinner than a cell of {smoke.cell_size:g} m and may emit nothing; enlarge it")
    _check_what_fills_source(job, path, solid, solids, findings)


def _check_source(job: Job, path: KeyPath, solid: Solid, standing: Sequence[Solid], findings: Findings) -> None:
    """A source that stays must be in the box and have cells of its own."""
    smoke = job.smoke[int(path[1])]
    box, cell_size = np.array(smoke.limits(job.domain)), smoke.cell_size
    inside = overlap(solid.bounds, box)
    if inside == 0.0:
        findings.error(path, f"is wholly outside the smoke's grid: it spans {span(solid.bounds)}, not {span(box)}")
        return
    if inside < ALL:
        findings.warn(path, f"{100 * (1 - inside):.0f} % of it are outside the smoke's grid and emit nothing")
    centres = _centres_inside(solid, box, smoke_box(smoke, job.domain)[0], cell_size)
    if centres is not None and len(centres) == 0:
        thinnest = float(np.min(solid.bounds[1] - solid.bounds[0]))
        findings.error(
            path,
            f"holds no centre of a cell: it is {thinnest:.3g} m thin, and cells are {cell_size:g} m; "
            "enlarge it or use a smaller cell_size",
        )
    elif centres is not None:
        for body in standing:
            if touch(body.bounds, solid.bounds, margin=0.0):
                centres = centres[body.signed_distance(centres) >= 0.0]
        if len(centres) == 0:
            findings.error(path, "lies wholly inside solid bodies, so it emits nothing; move it")


def _centres_inside(
    solid: Solid, box: Box, corner: NDArray[np.float64], cell_size: float
) -> NDArray[np.float64] | None:
    """Centres of cells in a box that a solid contains [m], (n, 3); None if there are too many cells around it.

    Some cell has a corner at `corner` [m].
    """
    low = np.maximum(solid.bounds[0], box[0])
    high = np.minimum(solid.bounds[1], box[1])
    first = np.ceil((low - corner) / cell_size - 0.5)
    last = np.floor((high - corner) / cell_size - 0.5)
    if np.prod(np.maximum(last - first + 1.0, 0.0)) > COUNTED_CELLS:
        return None
    axes = [start + (np.arange(a, b + 1.0) + 0.5) * cell_size for start, a, b in zip(corner, first, last, strict=True)]
    centres: NDArray[np.float64] = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside: NDArray[np.float64] = centres[solid.signed_distance(centres) < 0.0] if len(centres) else centres
    return inside


def _check_path(job: Job, path: KeyPath, solid: Solid, box: Box, findings: Findings) -> None:
    """The path of a source must come into the box."""
    source = job.smoke[int(path[1])].source[int(path[3])]
    reach = float(np.linalg.norm(solid.bounds[1] - solid.bounds[0]))
    if source.keyframe:
        low, high = path_through(source.keyframe, linear=source.interpolation == "linear").hull()
    else:
        low, high = path_of(next(body for body in job.rigid if body.name == source.follow)).hull()
        reach += math.hypot(*source.position)
    swept = np.stack([low - reach, high + reach])
    if not touch(swept, box, margin=0.0):
        findings.error(path, f"never comes into the smoke's grid: its path spans {span(swept)}, not {span(box)}")


def _check_what_fills_source(job: Job, path: KeyPath, source: Solid, solids: Solids, findings: Findings) -> None:
    """Note a source wholly within water, soft matter or a body that moves, as far as the corners of its box tell."""
    corners = np.array(np.meshgrid(*source.bounds.T)).reshape(3, 8).T
    followed = job.smoke[int(path[1])].source[int(path[3])].follow
    for other, solid in solids.items():
        body = job.rigid[int(other[1])] if other[0] == "rigid" else None
        is_own = body is not None and body.name == followed
        is_mover = body is not None and body.kind != "static"
        if not (is_own or is_mover or other[0] in ("fluid", "soft")) or not touch(
            solid.bounds, source.bounds, margin=0.0
        ):
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
