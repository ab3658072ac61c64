"""Rigid bodies as a job file names them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal, Self

from pydantic import Field, model_validator

from sim.parameters import Fraction, NonNegative, Parameters, Positive, Vector3
from sim.shapes.parameters import Placement


class RigidKeyframeParameters(Parameters):
    """Where something on a path is at one time."""

    time_s: NonNegative = Field(description="Time [s]; later than that of the keyframe before.")
    position: Vector3 = Field(description="World position of the shape's centre [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="Rotation about x, then y, then z (world axes) [degrees]; "
        "the way from one keyframe to the next is the shortest, below 180 degrees.",
    )


def placed_at_first_keyframe(data: Any, what: str) -> Any:
    """What a job file says of something with keyframes, with the pose of the first as its place.

    So everybody who asks where it starts gets that pose.

    Args:
        data: as it comes to a validator, before anything is known about it.
        what: how to call the thing in messages.

    Raises:
        ValueError: it is placed elsewhere as well.
    """
    if not isinstance(data, dict) or not isinstance(data.get("keyframe"), list | tuple) or not data["keyframe"]:
        return data
    first = data["keyframe"][0]
    placed = [key for key in ("position", "rotation_deg") if key in data]
    if isinstance(first, RigidKeyframeParameters):
        first = first.model_dump()
    if not isinstance(first, dict) or "position" not in first:
        return data  # the keyframe's own validation says what is wrong with it
    start = {key: first[key] for key in ("position", "rotation_deg") if key in first}
    for key in placed:
        if tuple(data[key]) != tuple(start.get(key, (0.0, 0.0, 0.0))):
            raise ValueError(f"{key} differs from that of the first keyframe, which places the {what}; remove {key}")
    return {**data, **start}


def require_ascending_times(keyframes: Sequence[RigidKeyframeParameters]) -> None:
    """Raises ValueError unless each keyframe is later than the one before."""
    for number, (before, after) in enumerate(pairwise(keyframes), start=1):
        if after.time_s <= before.time_s:
            raise ValueError(
                f"keyframe[{number}].time_s must be after {before.time_s:g} s, that of the keyframe before, "
                f"got {after.time_s:g} s"
            )


class BallastParameters(Parameters):
    """A small heavy piece fixed in a dynamic body, such as the weight that keeps a toy duck upright."""

    mass: Positive = Field(description="Mass [kg], on top of that of the density.")
    position: Vector3 = Field(description="Where it sits, from the shape's centre, before the body is turned [m].")


class RigidBodyParameters(Placement):
    """A rigid body: fixed, moved along a path, or moved by forces and contacts."""

    name: str = Field(description="Name of the body, unique in the job.", pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")
    kind: Literal["static", "kinematic", "dynamic"] = Field(
        default="static",
        description="static: never moves; kinematic: follows its keyframes, or its constant velocities, whatever it "
        "hits; dynamic: moved by gravity, contacts and fluid.",
    )
    density: Positive | None = Field(
        default=None,
        description="Mass per volume [kg/m³]; dynamic bodies need one. Within some 10 % of a fluid's, a body that "
        "starts deep below its surface rises or sinks slowly.",
    )
    ballast: tuple[BallastParameters, ...] = Field(
        default=(),
        description="Point masses fixed in a dynamic body: they shift its centre of mass and add to its inertia, and "
        "displace nothing.",
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
    keyframe: tuple[RigidKeyframeParameters, ...] = Field(
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
        return self

    @model_validator(mode="after")
    def _keyframes_are_in_order(self) -> Self:
        require_ascending_times(self.keyframe)
        return self
