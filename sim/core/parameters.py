"""The base of every parameter model in `sim`, and the vector types they share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Vector3 = tuple[float, float, float]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Device = Literal["auto", "cpu", "cuda", "vulkan", "metal"]


class Parameters(BaseModel):
    """Frozen, strict about unknown keys and about NaN; units stand in each field's description."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class KeyRefusedError(ValueError):
    """A rule of a whole table that one of its keys breaks, at `path` from that table."""

    def __init__(self, path: tuple[str | int, ...], message: str) -> None:
        super().__init__(message)
        self.path = path
