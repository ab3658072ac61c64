"""Rigid bodies as a job file names them."""

from __future__ import annotations

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from sim.core.motion.parameters import KeyframeParameters, placed_at_first_keyframe, require_ascending_times
from sim.core.parameters import BodyName, Fraction, NonNegative, Vector3
from sim.shapes.parameters import WeightedPlacement


class RigidBodyParameters(WeightedPlacement):
    """A rigid body: fixed, moved along a path, or moved by forces and contacts."""

    name: BodyName = Field(description="Name of the body, unique in the job.")
    kind: Literal["static", "kinematic", "dynamic"] = Field(
        default="static",
        description="static: never moves; kinematic: follows its keyframes, or its constant velocities, whatever it "
        "hits; dynamic: moved by gravity, contacts and fluid.",
    )
    velocity: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Velocity [m/s]: at the start, of the centre of mass (dynamic), or always (kinematic).",
    )
    angular_velocity: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Angular velocity about world axes [rad/s]: at the start (dynamic) or always (kinematic).",
    )
    friction: NonNegative = Field(
        default=0.5, description="Coulomb friction [-]; a pair of bodies has the geometric mean of its two."
    )
    restitution: Fraction = Field(
        default=0.0,
        description="Speed after an impact over the speed before [-]; a pair of bodies has the larger of its two. "
        "Where a rough body hits with an edge it may be less: no impact adds energy.",
    )
    keyframe: tuple[KeyframeParameters, ...] = Field(
        default=(), description="Path of a kinematic body; it rests before the first and after the last keyframe."
    )
    interpolation: Literal["cubic", "linear"] = Field(
        default="cubic",
        description="Between keyframes. cubic: velocities are continuous; linear: they are constant and jump.",
    )

    @model_validator(mode="before")
    @classmethod
    def _start_at_first_keyframe(cls, data: Any) -> Any:
        return placed_at_first_keyframe(data, "body")

    @model_validator(mode="after")
    def _has_only_what_its_kind_means(self) -> Self:
        given = self.model_fields_set
        if self.kind == "dynamic" and self.density is None:
            raise ValueError("density is missing; a dynamic body needs one, such as 600 kg/m³ for wood")
        if self.kind != "dynamic" and self.density is not None:
            raise ValueError(
                f"density has no meaning for a {self.kind} body, got {self.density:g} kg/m³; "
                'remove it or use kind = "dynamic"'
            )
        if self.kind != "dynamic" and self.ballast:
            raise ValueError(f'a {self.kind} body has no mass for ballast to add to; remove it or use kind = "dynamic"')
        if self.kind != "kinematic" and self.keyframe:
            raise ValueError(f'a {self.kind} body has no keyframes; remove them or use kind = "kinematic"')
        for key in ("velocity", "angular_velocity"):
            if self.kind == "static" and any(getattr(self, key)):
                raise ValueError(f'{key} has no meaning for a static body; remove it or use kind = "kinematic"')
            if self.keyframe and any(getattr(self, key)):
                raise ValueError(f"{key} of a body with keyframes comes from them; remove {key}")
        if "interpolation" in given and not self.keyframe:
            raise ValueError("interpolation has no meaning without keyframes; remove it or add [[rigid.keyframe]]")
        require_ascending_times(self.keyframe)
        return self
