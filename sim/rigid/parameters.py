"""Rigid bodies as a job file names them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from sim.shapes.parameters import Placement


def _refuse_moving_bodies(kind: object) -> object:
    if kind in ("dynamic", "kinematic"):
        raise ValueError(f'{kind} bodies are not simulated by this version; use kind = "static"')
    return kind


class RigidBodyParameters(Placement):
    """A rigid body: an obstacle for fluid and smoke."""

    name: str = Field(description="Name of the body, unique in the job.", pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")
    kind: Annotated[Literal["static"], BeforeValidator(_refuse_moving_bodies)] = Field(
        default="static", description="static: never moves."
    )
