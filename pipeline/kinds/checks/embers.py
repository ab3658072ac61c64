"""Checks of embers: sources that have an inside, in air."""

from __future__ import annotations

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.model.job import Job
from pipeline.model.problems import Findings

BYTES_PER_EMBER = 200
"""Of the solver, and the snapshots and checkpoints that wait to be written."""


def check_embers(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    """Note what is wrong with embers; returns how many can glow at one time."""
    total = 0
    boxes = {smoke.name: np.array(smoke.corners(job.domain)) for smoke in job.smoke if smoke.grid != "open"}
    for index, embers in enumerate(job.embers):
        total += embers.most
        for number, source in enumerate(embers.source):
            path = ("embers", index, "source", number)
            if source.start_s >= job.film_s:
                findings.warn((*path, "start_s"), f"is {source.start_s:g} s; the film ends at {job.film_s:g} s")
            if source.end_s is not None and source.end_s <= source.start_s:
                findings.error((*path, "end_s"), f"is {source.end_s:g} s, and start_s {source.start_s:g} s")
            box, solid = boxes.get(embers.smoke), solids.get(path)
            if box is None or solid is None:
                continue
            if (solid.bounds[1] <= box[0]).any() or (solid.bounds[0] >= box[1]).any():
                findings.warn(path, f'is outside of the box of "{embers.smoke}", where no air carries embers')
    if refusal := budget.refusal(total, "embers", BYTES_PER_EMBER):
        findings.error(("embers", 0, "source"), f"{refusal}; use a smaller rate")
    return total
