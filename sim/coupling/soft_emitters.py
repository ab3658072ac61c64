"""What the emitters of soft matter let in: where each of their particles comes out, when and how fast."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sim.coupling.soft_openings import opening_of
from sim.soft.pouring import Poured

if TYPE_CHECKING:
    from sim.soft.parameters import SoftParameters


def poured_by(soft: Sequence[SoftParameters]) -> Poured:
    """All that emitters will ever let in, by the time that it comes.

    Raises:
        ValueError: an opening is too narrow.
    """
    layers = []
    for index, body in enumerate(soft):
        for number, emitter in enumerate(body.emitter):
            try:
                opening = opening_of(emitter, body.spacing)
            except ValueError as error:
                raise ValueError(f'soft "{body.name}" emitter[{number}]: {error}') from error
            for layer in range(opening.layers_due(np.inf)):
                time_s = opening.leaves_at(layer)
                points, carrier = opening.points(layer, time_s), opening.motion(time_s)
                velocity = opening.velocity_at(points, carrier, opening.inflow.speed_at(time_s))
                layers.append(Poured.of_layer(points, velocity, time_s, index, emitter.dye))
    return Poured.together(layers)
