"""Emitters of fluid that are fixed to rigid bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sim.fluid.opening import placed_on

if TYPE_CHECKING:
    from sim.fluid.parameters import EmitterParameters, FluidParameters
    from sim.rigid.parameters import RigidBodyParameters


def with_emitters_on(
    fluids: Sequence[FluidParameters], bodies: Sequence[RigidBodyParameters]
) -> tuple[FluidParameters, ...]:
    """The fluids with their emitters on static bodies where these stand; only those on bodies that move still follow.

    Raises:
        ValueError: an emitter follows a body that is not there, or a piece of one that breaks.
    """
    by_name = {body.name: body for body in bodies}
    return tuple(
        fluid.model_copy(
            update={
                "emitter": tuple(
                    emitter_on(emitter, by_name, f'fluid "{fluid.name}" emitter[{number}]')
                    for number, emitter in enumerate(fluid.emitter)
                )
            }
        )
        for fluid in fluids
    )


def emitter_on(
    emitter: EmitterParameters, bodies: Mapping[str, RigidBodyParameters], name: str = "emitter"
) -> EmitterParameters:
    """An emitter, of this name in messages, as `with_emitters_on` has it; the bodies stand by name. Raises as that."""
    if emitter.follow is None:
        return emitter
    if emitter.follow not in bodies:
        raise ValueError(f'{name}: no rigid body is named "{emitter.follow}"')
    body = bodies[emitter.follow]
    if problem := follow_problem(body):
        raise ValueError(f"{name}: {problem}")
    return placed_on(emitter, body) if body.kind == "static" else emitter


def follow_problem(body: RigidBodyParameters) -> str | None:
    """Why no emitter can follow a body, if none can."""
    if body.whole is None:
        return None
    return f'"{body.name}" is a piece of "{body.whole}", which breaks; follow another body'
