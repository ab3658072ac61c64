"""Traits of the fluid solvers that others know without loading them, or Taichi."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SolverTraits:
    """Traits of one solver.

    Attributes:
        skin: reach of the neighbour list beyond the support [support radii]. More means fewer searches, and more pairs
            in every step.
        has_sound_speed: whether pressure follows the density, at a numerical speed of sound.
        extra_bytes: memory of a particle beyond that of WCSPH [bytes].
    """

    skin: float
    has_sound_speed: bool = False
    extra_bytes: int = 0


# What an implicit pressure has more: pressures, their acceleration, diagonal and errors.
_IMPLICIT_PRESSURE_BYTES = 40

TRAITS: Mapping[str, SolverTraits] = {
    "wcsph": SolverTraits(skin=0.1, has_sound_speed=True),
    # It takes steps in which particles use any skin up, and passes over the pairs many times in each.
    "dfsph": SolverTraits(skin=0.0, extra_bytes=_IMPLICIT_PRESSURE_BYTES),
    # It looks at the pairs where they will be.
    "pcisph": SolverTraits(skin=0.1, extra_bytes=_IMPLICIT_PRESSURE_BYTES),
}
"""Traits by the name of the solver; the solvers themselves are in `sim.fluid.solvers`."""
