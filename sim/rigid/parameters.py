"""Rigid bodies as a job file names them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, PrivateAttr, model_validator

from sim.core.motion.parameters import KeyframeParameters, placed_at_first_keyframe, require_ascending_times
from sim.core.parameters import BodyName, Fraction, KeyRefusedError, NonNegative, Vector3
from sim.rigid.break_parameters import BreakParameters
from sim.shapes.group_parameters import GroupedPlacement
from sim.shapes.parameters import AnimationShape, PieceShape, WeightedPlacement


class RigidBodyParameters(GroupedPlacement, WeightedPlacement):
    """A rigid body: fixed, moved along a path, or moved by forces and contacts; or a group of such bodies.

    A table with `count` is a group: its bodies share all other keys.
    """

    may_be_animated: ClassVar[bool] = True

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
    air_drag: NonNegative = Field(
        default=1.0,
        description="Coefficient by which the air of a [[force]], moving or still, presses on faces that it blows onto "
        "[-]: the drag coefficient of a plate across it, twice that of a ball. Without such a force there is no air "
        "but in the box of a smoke, where its pressure acts instead.",
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

    breaks: BreakParameters | None = Field(
        default=None, description="Pieces that the body breaks into; a dynamic body without it never breaks."
    )

    _group: str | None = PrivateAttr(default=None)
    _model: str | None = PrivateAttr(default=None)
    _whole: str | None = PrivateAttr(default=None)

    @property
    def whole(self) -> str | None:
        """Name of the body that it is a piece of."""
        return self._whole

    @property
    def group(self) -> str:
        """Name of the group that it is of; its own if it is of none."""
        return self._group or self.name

    @property
    def model(self) -> str:
        """Name of the body whose mesh it shares: the first of its group of that size; its own if it is of none."""
        return self._model or self.name

    @property
    def is_own_model(self) -> bool:
        """Whether its mesh is not that of another body."""
        return self.model == self.name

    def placed(self, table: int, *, member: int | None = None, model: str | None = None, **values: Any) -> Self:
        """A body of a table of this number, with other values; one of a group with the name of its model."""
        body = super().placed(table, member=member, **values)
        if model is not None:
            body._group, body._model = self.group, model
        return body

    def broken_down(self) -> Iterator[Self]:
        """The pieces of a body of a job that breaks, where they are in it; else the body itself."""
        if self.breaks is None or self._whole is not None:
            yield self
            return
        pieces, seed = self.breaks.pieces, self.breaks.seed
        for number in range(1, 1 + (pieces or len(getattr(self.shape, "part", ())))):
            shape = PieceShape(type="piece", of=self.shape, pieces=pieces, seed=seed, number=number)
            piece = self.placed(self.table, model=f"{self.model}_{number}", name=f"{self.name}_{number}", shape=shape)
            piece._whole = self.name
            yield piece

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
        if self.breaks is not None:
            if self.kind != "dynamic":
                raise KeyRefusedError(("breaks",), f'has no meaning for a {self.kind} body; use kind = "dynamic"')
            if self.ballast:
                raise KeyRefusedError(("ballast",), "is in no piece of a body that breaks; make it a part of one")
            if self.breaks.pieces is None and (self.shape.type != "compound" or len(self.shape.part) < 2):
                raise KeyRefusedError(
                    ("breaks", "pieces"), "is missing; only a compound of two parts or more has pieces without it"
                )
        if self.kind != "kinematic" and self.keyframe:
            raise ValueError(f'a {self.kind} body has no keyframes; remove them or use kind = "kinematic"')
        for key in ("velocity", "angular_velocity"):
            if self.kind == "static" and any(getattr(self, key)):
                raise ValueError(f'{key} has no meaning for a static body; remove it or use kind = "kinematic"')
            if self.keyframe and any(getattr(self, key)):
                raise ValueError(f"{key} of a body with keyframes comes from them; remove {key}")
        if self.count is not None and self.keyframe:
            raise KeyRefusedError(("keyframe",), "would lead all bodies of a group through one place; give velocity")
        if "interpolation" in given and not self.keyframe:
            raise ValueError("interpolation has no meaning without keyframes; remove it or add [[rigid.keyframe]]")
        require_ascending_times(self.keyframe)
        return self

    @model_validator(mode="after")
    def _is_moved_by_its_file_alone(self) -> Self:
        if not isinstance(self.shape, AnimationShape):
            return self
        if self.kind != "kinematic":
            raise KeyRefusedError(("kind",), 'of a body that a file animates is "kinematic": nothing else moves it')
        for key in ("velocity", "angular_velocity"):
            if any(getattr(self, key)):
                raise KeyRefusedError((key,), "of a body that a file animates comes from there; remove it")
        if self.keyframe:
            raise KeyRefusedError(("keyframe",), "cannot lead a body that a file animates; move it there, or remove it")
        if self.count is not None:
            raise KeyRefusedError(("count",), "cannot be of a body that a file animates; write a table for each")
        return self
