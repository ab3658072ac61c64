"""The box that everything happens in."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from sim.core.parameters import Parameters, Vector3

Face = Literal["x-", "x+", "y-", "y+", "z-", "z+"]


def _each_once(faces: tuple[Face, ...]) -> tuple[Face, ...]:
    if twice := [face for face in faces if faces.count(face) > 1]:
        raise ValueError(f'names "{twice[0]}" more than once')
    return faces


Faces = Annotated[tuple[Face, ...], AfterValidator(_each_once)]


class DomainParameters(Parameters):
    """The box that the fluid lives in; its closed faces are walls."""

    min: Vector3 = Field(default=(-0.5, -0.5, 0.0), description="Lower corner [m].")
    max: Vector3 = Field(default=(0.5, 0.5, 1.0), description="Upper corner [m].")
    open_faces: Faces = Field(
        default=("z+",),
        description="Faces without a wall; fluid that leaves through them is removed and counted.",
    )

    @property
    def middle(self) -> Vector3:
        """Its middle [m]."""
        x, y, z = (0.5 * (low + high) for low, high in zip(self.min, self.max, strict=True))
        return x, y, z

    @model_validator(mode="after")
    def _has_volume(self) -> Self:
        for axis, low, high in zip("xyz", self.min, self.max, strict=True):
            if high <= low:
                raise ValueError(f"max must be above min on every axis, got {axis} from {low:g} to {high:g} m")
        return self
