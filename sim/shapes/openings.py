"""Openings from which particles flow in, as a job file names them."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sim.core.motion.parameters import (
    KeyframeParameters,
    RampPointParameters,
    placed_at_first_keyframe,
    require_ascending_times,
)
from sim.core.parameters import Fraction, NonNegative, Parameters, Positive, Vector3
from sim.shapes.filled_parameters import DYE
from sim.shapes.inflow import Inflow
from sim.shapes.parameters import Shape


class DiscOpening(Parameters):
    """A round opening."""

    type: Literal["disc"]
    radius: Positive = Field(description="Radius [m].")


class RectangleOpening(Parameters):
    """A rectangular opening; its first side is horizontal, along y where the emitter points up or down."""

    type: Literal["rectangle"]
    size: tuple[Positive, Positive] = Field(description="Lengths of its sides [m].")


OpeningShape = DiscOpening | RectangleOpening | Shape


class InflowParameters(Parameters):
    """An opening from which particles flow into the domain, free as soon as they have passed it."""

    shape: Annotated[OpeningShape, Field(discriminator="type")] = Field(
        description="The opening: a disc, a rectangle, or what a plane through the centre of another shape cuts out of "
        "it, across its z axis, which points along the flow."
    )
    position: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="Centre of the opening [m]; from keyframes if it has some."
    )
    direction: Vector3 = Field(description="Direction of the flow, of any length but 0 [-].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Rotation of the opening and its direction about x, then y, then z (world axes) [degrees].",
    )
    speed: Positive | None = Field(
        default=None, description="Speed of the inflow relative to the opening [m/s]; the flow is speed times area."
    )
    flow_rate: Positive | None = Field(
        default=None,
        description="Volume that flows in per time [m³/s], instead of the speed; 0.001 is a litre a second.",
    )
    ramp: tuple[RampPointParameters, ...] = Field(
        default=(),
        description="Its strength over time, as part of speed or flow_rate: linear between these points, and constant "
        "before and after them; 1 if omitted.",
    )
    start_s: NonNegative = Field(default=0.0, description="When it starts to emit [s].")
    end_s: Positive | None = Field(default=None, description="When it stops [s]; never if omitted.")
    total_volume: Positive | None = Field(
        default=None, description="Volume after which it stops [m³], to a particle; 0.001 is a litre. None if omitted."
    )
    dye: Fraction = Field(default=0.0, description=f"{DYE} of what flows in.")
    keyframe: tuple[KeyframeParameters, ...] = Field(
        default=(), description="Path of the opening; it rests before the first and after the last keyframe."
    )
    interpolation: Literal["cubic", "linear"] = Field(
        default="cubic",
        description="Between keyframes. cubic: velocities are continuous; linear: they are constant and jump.",
    )

    @model_validator(mode="before")
    @classmethod
    def _start_at_first_keyframe(cls, data: Any) -> Any:
        return placed_at_first_keyframe(data, "emitter")

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if not any(self.direction):
            raise ValueError("direction must not be (0, 0, 0)")
        if not {"position", "keyframe"} & self.model_fields_set:
            raise ValueError("position is missing; add it, or keyframes")
        if (self.speed is None) == (self.flow_rate is None):
            given = "has neither speed nor" if self.speed is None else "has both speed and"
            remedy = "add one of them" if self.speed is None else "remove one, as the flow is speed times area"
            raise ValueError(f"{given} flow_rate; {remedy}")
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s must be after start_s = {self.start_s:g} s, got {self.end_s:g} s")
        require_ascending_times(self.keyframe)
        require_ascending_times(self.ramp, "ramp")
        if "interpolation" in self.model_fields_set and not self.keyframe:
            raise ValueError("interpolation has no meaning without keyframes; remove it or add keyframes")
        return self

    @property
    def area(self) -> float:
        """Area of the opening [m²]. Raises ShapeError where its shape cannot be built."""
        if isinstance(self.shape, RectangleOpening):
            return math.prod(self.shape.size)
        if isinstance(self.shape, DiscOpening):
            return math.pi * self.shape.radius**2
        from sim.shapes.section import section_of  # builds the shape, which most readers of a job do without

        return section_of(self.shape).area

    @property
    def inflow_speed(self) -> float:
        """Speed of the inflow relative to the opening at full strength [m/s]. Raises as `area`."""
        return self.speed if self.speed is not None else (self.flow_rate or 0.0) / self.area

    @property
    def inflow(self) -> Inflow:
        """How far they have come through the opening at each time. Raises as `area`."""
        most = math.inf if self.total_volume is None else self.total_volume / self.area
        strengths = [(point.time_s, point.strength) for point in self.ramp]
        return Inflow.of(self.inflow_speed, strengths, self.start_s, self.end_s, most)

    def emitted_volume(self, until_s: float) -> float:
        """Volume that flows in until a time [s], as far as there is room [m³]. Raises as `area`."""
        return self.area * self.inflow.travel_at(until_s)
