"""Checks of soft matter: memory, blocks, and bodies that are too thin for its grid."""

from __future__ import annotations

import math

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.jets import check_jets
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.checks.openings import check_opening, check_speeds
from pipeline.kinds.checks.shapes import mesh_exists
from pipeline.model.amounts import rounded_up
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.coupling.soft_openings import opening_of, pours_outside
from sim.fluid.opening import Opening
from sim.shapes.filled_volume import Surroundings, amount
from sim.shapes.placement import PlacedSolid
from sim.soft.parameters import SoftParameters, coarse_for_fluid, shared_conflicts

BYTES_PER_PARTICLE = 560
"""Of the solver with the nodes around a particle, and the snapshots and checkpoints that wait to be written."""
BYTES_BESIDE_FLUID = 300
"""Of a particle as a sample that fluid feels, on top."""
BYTES_BESIDE_CLOTH = 90
"""Of a particle as sheets meet it, on top."""
FEWEST_CELLS = 3.0
"""Cells across a body, or a block, below which it is told: fewer bend, and are met, in no way that means much."""
FINEST = 0.4
"""Distance of particles over that of a fluid's below which it is told."""
SHORTEST_STEP_S = 2.0e-6


def check_soft(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    """Note what is wrong with soft bodies; returns their particles by the film's end."""
    for number, key, message in shared_conflicts(job.soft):
        findings.error(("soft", number, key), message)
    walls = [solid for path, solid in solids.items() if path[0] == "rigid"]
    filled: list[PlacedSolid] = []
    total = later = 0
    for index, soft in enumerate(job.soft):
        _check_steps(job, index, soft, findings)
        check_speeds(job, ("soft", index), findings)
        for number in range(len(soft.block)):
            path = ("soft", index, "block", number)
            if (solid := solids.get(path)) is None:
                continue
            particles = amount(solid, soft.spacing, Surroundings.in_domain(job.domain, walls, filled)).particles
            if particles == 0:
                findings.error(
                    path,
                    "has no particle: it is outside the domain, inside solids, or filled by the blocks before it; move "
                    "it, or use a smaller cell_size",
                )
            elif (thin := float(np.min(np.ptp(solid.bounds, axis=0)))) < FEWEST_CELLS * soft.cell_size:
                findings.warn(
                    path,
                    f"is {thin:.3g} m thin, less than {FEWEST_CELLS:g} cells of {soft.cell_size:g} m, and will be too "
                    f"stiff; use cell_size = {thin / FEWEST_CELLS:.2g} or less",
                )
            filled.append(solid)
            total += particles
        total += _poured(soft, job.film_s)
        later += _poured(soft, math.inf) - _poured(soft, job.film_s)
    each = BYTES_PER_PARTICLE + (BYTES_BESIDE_FLUID if job.fluid else 0) + (BYTES_BESIDE_CLOTH if job.cloth else 0)
    if refusal := budget.refusal(total + later, "particles of soft matter", each):
        findings.error(("soft", 0, "cell_size"), f"{refusal}; use a larger cell_size")
    _check_emitters(job, solids, findings, are_few=refusal is None)
    if job.soft and job.fluid:
        _check_fluid(job.soft[0], job.fluid[0].spacing, findings)
    if job.soft:
        _check_bodies(job, solids, job.soft[0].cell_size, findings)
    return total


def _poured(soft: SoftParameters, until_s: float) -> int:
    """Particles that emitters let in until a time [s], about."""
    return sum(round(each.emitted_volume(until_s) / soft.spacing**3) for each in soft.emitter)


def _check_steps(job: Job, index: int, soft: SoftParameters, findings: Findings) -> None:
    """Refuse what is so stiff that a frame would take no end of steps."""
    step = soft.longest_step
    if step < SHORTEST_STEP_S:
        findings.error(
            ("soft", index, "young_modulus"),
            f"{soft.value('young_modulus'):.3g} Pa need steps of {step:.2g} s, "
            f"{rounded_up(1.0 / (job.fps * step)):,.0f} a frame; "
            f"{soft.value('young_modulus') * (step / SHORTEST_STEP_S) ** 2:.2g} Pa or less would do, or larger cells",
        )


def _check_emitters(job: Job, solids: Solids, findings: Findings, *, are_few: bool) -> None:
    """Note what is wrong with emitters; their ways are only looked at where there is memory for what they pour."""
    openings: dict[KeyPath, Opening] = {}
    for index, soft in enumerate(job.soft):
        for number, emitter in enumerate(soft.emitter):
            path: KeyPath = ("soft", index, "emitter", number)
            if not mesh_exists(emitter.shape, path, findings):
                continue
            try:
                opening = opening_of(emitter, soft.spacing)
            except ValueError as error:
                findings.error((*path, "shape"), str(error).replace("particle_radius", "cell_size"))
                continue
            is_free = check_opening(job, path, opening, openings, solids, findings=findings)
            if is_free and are_few and (reason := pours_outside(opening, job.domain)):
                findings.error(path, reason)
            openings[path] = opening
    if openings:
        check_jets(job, solids, openings, job.soft[0].spacing, findings)


def _check_fluid(soft: SoftParameters, spacing: float, findings: Findings) -> None:
    """Refuse cells that fluid of a spacing [m] would slip through, and warn of so fine ones that it gets slow."""
    path = ("soft", 0, "cell_size")
    if coarse := coarse_for_fluid(soft, spacing):
        findings.error(path, coarse)
    elif soft.spacing < FINEST * spacing:
        felt = round(2.0 / 3.0 * np.pi * (2.0 * spacing / soft.spacing) ** 3)
        findings.warn(
            path,
            f"of {soft.cell_size:g} m is far finer than the fluid, whose particles are {spacing:g} m apart: each of "
            f"these feels some {felt} of soft matter where they touch; use {2.0 * spacing:.2g} m, or a smaller "
            "fluid.particle_radius",
        )


def _check_bodies(job: Job, solids: Solids, cell_size: float, findings: Findings) -> None:
    """Warn of bodies that nodes of the grid could miss, of the pieces of one that breaks of the thinnest."""
    shards: dict[str, list[tuple[float, KeyPath]]] = {}
    for path, solid in solids.items():
        thin = float(np.min(np.ptp(solid.bounds, axis=0)))
        if path[0] != "rigid" or thin >= FEWEST_CELLS * cell_size:
            continue
        whole = job.rigid[int(path[1])].whole
        if whole is not None:
            shards.setdefault(whole, []).append((thin, path))
            continue
        findings.warn(
            path,
            f"is {thin:.3g} m thin, less than {FEWEST_CELLS:g} cells of soft matter, {cell_size:g} m, which may "
            f"pass through it; use soft.cell_size = {thin / FEWEST_CELLS:.2g} or less, or a thicker body",
        )
    for whole, found in shards.items():
        thin, path = min(found)
        findings.warn(
            (*path[:2], "breaks"),
            f'"{whole}" has pieces, {len(found)} in all, of less than {FEWEST_CELLS:g} cells of soft matter, '
            f'{cell_size:g} m, the thinnest, "{job.rigid[int(path[1])].name}", of {thin:.3g} m: it may pass through '
            f"them once they have broken off; use soft.cell_size = {thin / FEWEST_CELLS:.2g} or less, or fewer pieces",
        )
