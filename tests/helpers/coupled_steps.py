"""How a small tank steps: a fluid, what is coupled to it, and the coupling, without the frames of a world."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim.core.solver import Coupling, Solver


class CoupledSteps:
    """A fluid and another solver that step together.

    Attributes:
        fluid: steps first.
        other: what is coupled to it.
        coupling: between both.
    """

    def __init__(self, fluid: Solver, other: Solver, coupling: Coupling) -> None:
        self.fluid, self.other, self.coupling = fluid, other, coupling

    def step(self) -> float:
        """One coupled substep; returns its length [s]."""
        dt = min(self.fluid.stable_dt(), self.other.stable_dt())
        self.fluid.substep(dt)
        self.coupling.exchange(dt)
        self.other.substep(dt)
        self.coupling.follow(dt)
        return dt

    def run(self, duration: float) -> float:
        """Coupled substeps for a time [s], or the little more that they took, which is returned."""
        time = 0.0
        while time < duration:
            time += self.step()
            assert self.fluid.first_bad_quantity() is None
            assert self.other.first_bad_quantity() is None
        return time
