"""Openings of the emitters of soft matter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sim.fluid.opening import Opening
from sim.fluid.parameters import EmitterParameters

if TYPE_CHECKING:
    from sim.soft.parameters import SoftEmitterParameters


def opening_of(emitter: SoftEmitterParameters, spacing: float) -> Opening:
    """The opening of an emitter for particles of a spacing [m], as a fluid's would be. Raises as `Opening.of`."""
    as_of_fluid = EmitterParameters.model_validate(emitter.model_dump(exclude_unset=True))
    return Opening.of(as_of_fluid, spacing, spacing**3)
