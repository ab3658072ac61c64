"""What the emitters of soft matter let in: where each of their particles comes out, when and how fast."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from sim.coupling.soft_openings import opening_of, poured_layers, pours_outside
from sim.fluid.opening_conflicts import opening_problem
from sim.soft.pouring import Poured

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.fluid.opening import Opening
    from sim.shapes.solid import Solid
    from sim.soft.parameters import SoftParameters


def poured_by(soft: Sequence[SoftParameters], domain: DomainParameters, solids: Sequence[Solid]) -> Poured:
    """All that emitters will ever let in, by the time that it comes.

    Raises:
        ValueError: an opening is too narrow, in a solid or another's way at the start, or pours outside the domain.
    """
    layers = []
    openings: dict[str, Opening] = {}
    for index, body in enumerate(soft):
        for number, emitter in enumerate(body.emitter):
            name = f'soft "{body.name}" emitter[{number}]'
            try:
                opening = opening_of(emitter, body.spacing)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
            reason = opening_problem(opening, body.spacing, domain, solids, openings)
            if reason := reason or pours_outside(opening, domain):
                raise ValueError(f"{name}: {reason}")
            openings[name] = opening
            for time_s, points in poured_layers(opening):
                velocity = opening.velocity_at(points, opening.motion(time_s), opening.inflow.speed_at(time_s))
                layers.append(Poured.of_layer(points, velocity, time_s, index, emitter.dye))
    return Poured.together(layers)
