"""The cases by name. A module of this folder is one: what is computed, against what, how exactly, and its figure."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from validation.checks import CaseResult, Check

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CASES = (
    "kernel", "hydrostatic", "dam-break", "box-impact", "turned-jet", "rayleigh-taylor", "elliptical-drop",
    "swinging-drop", "viscosity",
    "free-momentum", "coupled-momentum", "rigid-motion", "rigid-contacts", "joints", "pyramid", "inertia",
    "cloth", "cloth-crossings", "soft-bar", "sand-columns",
    "smoke-vortices", "smoke-projection", "smoke-solids", "smoke-wake", "smoke-plume", "smoke-front", "smoke-mass",
    "submerged-sphere", "buoyancy", "bunny-energy",
)  # fmt: skip
"""In the order in which they are computed; each in the module of its name."""

Found = tuple[Sequence[Check], Mapping[str, Any]]
"""The numbers of a case, and curves for its figure, by name."""


@dataclass(frozen=True)
class Case:
    """One case, of the name of its module; sizes are those of the full case, and of the one that a test can afford."""

    find: Callable[..., Found]  # computes it, given the solver's name and the sizes
    draw: Callable[[Sequence[CaseResult]], Figure] | None = None  # its figure, given the results of all solvers
    solvers: tuple[str, ...] = ("wcsph", "dfsph", "pcisph")  # which it is computed with
    sizes: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)  # resolutions, durations and what else differs

    @property
    def name(self) -> str:
        """As on the command line and of its files."""
        return self.find.__module__.rpartition(".")[2].replace("_", "-")

    def settings(self, sizes: Mapping[str, Any]) -> dict[str, Any]:
        """What was computed: the sizes, and the numbers that its module names."""
        named = vars(sys.modules[self.find.__module__])
        return {**{name.lower(): each for name, each in named.items() if name.isupper() and _is_number(each)}, **sizes}

    def compute(self, solver: str, *, quick: bool = False, device: str = "cpu") -> CaseResult:
        """The case with one solver, and how long it took; Taichi must have been started, on that device."""
        sizes = {name: each[quick] for name, each in self.sizes.items()}
        start = time.perf_counter()
        checks, series = self.find(solver, **sizes)
        seconds = time.perf_counter() - start
        return CaseResult(self.name, solver, self.settings(sizes), checks, series, seconds, device)


def load_case(name: str) -> Case:
    """The case of this name. Raises ModuleNotFoundError for an unknown one."""
    return import_module(f"validation.cases.{name.replace('-', '_')}").CASE


def _is_number(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_is_number(each) for each in value)
    return isinstance(value, int | float)
