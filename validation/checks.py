"""What a validation case returns: numbers against what they should be, and curves for its figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

TITLES = {
    "wcsph": "WCSPH",
    "dfsph": "DFSPH",
    "pcisph": "PCISPH",
    "rigid": "value",
    "cloth": "value",
    "smoke": "value",
    "soft": "value",
    "maccormack": "MacCormack",
    "semi_lagrangian": "semi-Lagrangian",
}
"""Of solvers, in the order of the page; "value" where the solvers share the code."""

SIGNIFICANT_DIGITS = 6  # of the numbers that are written: more than any tolerance here asks for, few enough to read


@dataclass(frozen=True)
class Check:
    """One number against what it should be."""

    name: str  # what is compared, in words
    value: float  # what came out
    expected: float  # what theory or experiment says; 0 for an error that is bounded
    tolerance: float  # largest |value - expected| that passes
    reason: str  # why this much and no more
    unit: str = "-"  # of all three numbers; "-" for ratios

    @property
    def holds(self) -> bool:
        """Whether the number is as it should be; a NaN never is."""
        return abs(self.value - self.expected) <= self.tolerance

    def __str__(self) -> str:
        verdict = "ok" if self.holds else "FAILS"
        unit = "" if self.unit == "-" else f" {self.unit}"
        return f"{verdict:5} {self.name}: {self.value:.5g}{unit}, expected {self.expected:.5g} ± {self.tolerance:.3g}"


@dataclass(frozen=True)
class CaseResult:
    """What one solver made of one case."""

    case: str  # name of the case
    solver: str  # "wcsph", "dfsph" or "pcisph"; "rigid" where no fluid is in it, "all" where the solvers share the code
    settings: Mapping[str, Any]  # what was computed: sizes, resolutions, durations, in SI units
    checks: Sequence[Check]  # the numbers
    series: Mapping[str, Sequence[float]] = field(default_factory=dict)  # curves for the figure, by name
    seconds: float = 0.0  # time that it took [s], on a machine that other work shares
    device: str = "cpu"  # what Taichi ran on

    @property
    def failures(self) -> list[str]:
        """The checks that do not hold, in words."""
        return [str(check) for check in self.checks if not check.holds]

    def as_json(self) -> dict[str, Any]:
        """Plain data, numbers rounded."""
        return _rounded(asdict(self))

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> CaseResult:
        """What `as_json` wrote."""
        return cls(**{**data, "checks": [Check(**check) for check in data["checks"]]})


def fitted_order(spacings: Sequence[float], errors: Sequence[float]) -> float:
    """Slope of log(error) over log(spacing), by least squares."""
    return float(np.polyfit(np.log(spacings), np.log(np.abs(errors)), 1)[0])


def order_of_differences(coarse: Any, middle: Any, fine: Any) -> float:
    """Order by which a number, or an array, converges where each refinement halves the spacing."""
    first, second = np.linalg.norm(np.subtract(middle, coarse)), np.linalg.norm(np.subtract(fine, middle))
    return math.log2(first / second)


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _rounded(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{float(value):.{SIGNIFICANT_DIGITS}g}")
    return value.item() if isinstance(value, np.generic) else value
