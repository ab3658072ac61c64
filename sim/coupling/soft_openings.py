"""Openings of the emitters of soft matter."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.fluid.opening import Opening
from sim.fluid.parameters import EmitterParameters

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.soft.parameters import SoftEmitterParameters


def opening_of(emitter: SoftEmitterParameters, spacing: float) -> Opening:
    """The opening of an emitter for particles of a spacing [m], as a fluid's would be. Raises as `Opening.of`."""
    as_of_fluid = EmitterParameters.model_validate(emitter.model_dump(exclude_unset=True))
    return Opening.of(as_of_fluid, spacing, spacing**3)


def poured_layers(opening: Opening) -> Iterator[tuple[float, NDArray[np.float64]]]:
    """Each layer that leaves an opening: when [s], and where its particles are then [m], (m, 3)."""
    for layer in range(opening.layers_due(np.inf)):
        time_s = opening.leaves_at(layer)
        yield time_s, opening.points(layer, time_s)


def pours_outside(opening: Opening, domain: DomainParameters) -> str | None:
    """Why an opening that starts in the domain cannot go where it goes, or None: it pours outside on its way."""
    for time_s, points in poured_layers(opening) if opening.moves else ():
        if ((points < domain.min) | (points > domain.max)).any():
            return (
                f"its keyframes take its opening out of the domain, where it pours at {time_s:.3g} s; keep it inside, "
                "or end it before"
            )
    return None
