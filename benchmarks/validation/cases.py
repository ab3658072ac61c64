"""The cases by name: what computes each, with which solvers, and what draws it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING

from benchmarks.validation.checks import CaseResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CASES = {
    "kernel": "kernel",
    "hydrostatic": "hydrostatic",
    "dam-break": "dam_break",
    "elliptical-drop": "elliptical_drop",
    "viscosity": "viscosity",
    "free-momentum": "free_momentum",
    "coupled-momentum": "coupled_momentum",
    "rigid-motion": "rigid_motion",
    "rigid-contacts": "rigid_contacts",
    "inertia": "inertia",
    "cloth": "cloth",
    "smoke-vortices": "smoke_vortices",
    "smoke-projection": "smoke_projection",
    "smoke-plume": "smoke_plume",
    "smoke-front": "smoke_front",
    "smoke-mass": "smoke_mass",
    "submerged-sphere": "submerged_sphere",
    "buoyancy": "buoyancy",
    "bunny-energy": "bunny_energy",
}
"""Case to module of this folder."""


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: as on the command line and of its files.
        solvers: which it is computed with.
        run: computes it with one of them; quick: at resolutions that a test can afford.
    """

    name: str
    solvers: tuple[str, ...]
    run: Callable[..., CaseResult]


def load_case(name: str) -> Case:
    """The case of this name. Raises KeyError for an unknown one."""
    module = import_module(f"benchmarks.validation.{CASES[name]}")
    return Case(name, tuple(module.SOLVERS), module.run)


def compute(name: str, solver: str, *, quick: bool = False) -> CaseResult:
    """One case with one solver, and how long it took; Taichi must have been started."""
    start = time.perf_counter()
    result = load_case(name).run(solver, quick=quick)
    return replace(result, seconds=time.perf_counter() - start)


def draw(name: str, results: Sequence[CaseResult]) -> Figure | None:
    """The figure of a case with all solvers, or None where it is all numbers."""
    from benchmarks.validation import figures

    drawing = figures.DRAWINGS.get(name)
    return None if drawing is None else drawing(results)
