"""Joints between rigid bodies as a job file names them, and what is wrong with those of a scene."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import AfterValidator, Field, model_validator

from sim.core.parameters import BodyName, NonNegative, Parameters, Positive, Vector3
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of

RIGID_KINDS = ("fixed", "hinge", "slider", "ball")
"""Kinds that hold two bodies at one point; the others hold two points."""

NO_LENGTH = 1.0e-9  # of a line or an axis that has no direction
LENGTH_ROUNDING = 1.0e-6  # by which a length may miss the distance at the start, as decimals do not add up exactly

JointKind = Literal["fixed", "hinge", "slider", "ball", "distance", "spring", "rope"]


def _ascending(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] < limits[1]:
        raise ValueError(f"must be the lower and the upper one, got {limits[0]:g} and {limits[1]:g}")
    if not limits[0] <= 0.0 <= limits[1]:
        raise ValueError(f"{limits[0]:g} to {limits[1]:g} excludes the start, where it is 0; include it")
    return limits


def _with_direction(axis: Vector3) -> Vector3:
    if math.hypot(*axis) < NO_LENGTH:
        raise ValueError("has no direction; give it a length above 0, such as [0, 0, 1]")
    return axis


Limits = Annotated[tuple[float, float], AfterValidator(_ascending)]


class MotorParameters(Parameters):
    """What drives a hinge or a slider."""

    speed: float | None = Field(
        default=None, description="Of the first body against the second, about or along the axis [rad/s], [m/s]."
    )
    angle_deg: float | None = Field(
        default=None, description="Angle of a hinge that it turns to, from the start on [degrees]."
    )
    position: float | None = Field(default=None, description="Position of a slider that it goes to [m].")
    response_s: Positive = Field(
        default=0.1, description="Time in which the way to angle_deg or position falls to 1/e [s]."
    )
    max_torque: Positive | None = Field(default=None, description="Largest torque at a hinge [N m].")
    max_force: Positive | None = Field(default=None, description="Largest force at a slider [N].")

    @model_validator(mode="after")
    def _has_one_aim(self) -> Self:
        aims = [key for key in ("speed", "angle_deg", "position") if getattr(self, key) is not None]
        if len(aims) != 1:
            raise ValueError(f"needs one of speed, angle_deg and position, got {' and '.join(aims) or 'none'}")
        if "response_s" in self.model_fields_set and aims == ["speed"]:
            raise ValueError("response_s has no meaning for a speed; remove it")
        return self


class JointParameters(Parameters):
    """A joint between two rigid bodies, or one and the world, or a point of a cloth."""

    name: BodyName = Field(description="Name of the joint, unique among joints.")
    kind: JointKind = Field(
        description="fixed: as if glued; hinge: turns about an axis; slider: goes along one; ball: about a point; "
        "distance: a rod between two points; spring: with a damper; rope: no longer than its length."
    )
    between: tuple[BodyName, ...] = Field(
        min_length=1,
        max_length=2,
        description="Names of two rigid bodies, or of one that is joined to the world; or of one and a cloth, of which "
        "the node nearest to the anchor is held.",
    )
    anchor: Vector3 | None = Field(
        default=None,
        description="Where the joint is at the start [m], in world coordinates; a fixed joint and a slider have it at "
        "the first body's position if omitted.",
    )
    anchors: tuple[Vector3, Vector3] | None = Field(
        default=None,
        description="The two points at the start [m], in world coordinates, of a distance, spring or rope, on the "
        "first and on the second body; the positions of the bodies if omitted.",
    )
    axis: Annotated[Vector3, AfterValidator(_with_direction)] | None = Field(
        default=None, description="Of a hinge, a slider, or the cone of a ball, at the start, in world coordinates."
    )
    limits_deg: Limits | None = Field(
        default=None, description="Lowest and highest angle of a hinge [degrees], 0 at the start, of the first body."
    )
    limits: Limits | None = Field(
        default=None, description="Lowest and highest position of a slider [m], 0 at the start, of the first body."
    )
    cone_deg: Annotated[float, Field(gt=0.0, lt=180.0)] | None = Field(
        default=None, description="How far a ball's axis may turn from that of the other body [degrees]."
    )
    length: NonNegative | None = Field(
        default=None,
        description="Of a distance or rope, or of a spring without force [m]; the distance at the start if omitted.",
    )
    stiffness: Positive | None = Field(default=None, description="Of a spring [N/m].")
    damping: NonNegative = Field(default=0.0, description="Of a spring's damper [N s/m].")
    motor: MotorParameters | None = Field(default=None, description="Drives a hinge or a slider.")
    breaks_at: Positive | None = Field(
        default=None,
        description="Force at which it breaks for good [N]: the mean over a step, so that short blows count less.",
    )
    breaks_at_torque: Positive | None = Field(
        default=None, description="Torque at which a fixed joint, hinge or slider breaks, its motor's included [N m]."
    )
    contacts: bool = Field(default=False, description="Whether the two bodies touch each other.")

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> Self:
        needed = {"hinge": ("anchor", "axis"), "slider": ("axis",), "ball": ("anchor",), "spring": ("stiffness",)}
        missing = [key for key in needed.get(self.kind, ()) if getattr(self, key) is None]
        if missing:
            raise ValueError(f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing; a {self.kind} "
                             "needs it")  # fmt: skip
        if (self.cone_deg is None) != (self.axis is None) and self.kind == "ball":
            raise ValueError("a ball's cone needs both axis and cone_deg; add the other one or remove this one")
        if len(self.between) == 2 and self.between[0] == self.between[-1]:
            raise ValueError(f'joins "{self.between[0]}" to itself; name another body, or it alone for the world')
        self._refuse_keys_of_others()
        if self.motor is not None:
            self._check_motor(self.motor)
        return self

    def _refuse_keys_of_others(self) -> None:
        lines = ("distance", "spring", "rope")
        kinds = {
            "anchor": RIGID_KINDS,
            "anchors": lines,
            "axis": ("hinge", "slider", "ball"),
            "limits_deg": ("hinge",),
            "limits": ("slider",),
            "cone_deg": ("ball",),
            "length": lines,
            "stiffness": ("spring",),
            "damping": ("spring",),
            "motor": ("hinge", "slider"),
            "breaks_at_torque": ("fixed", "hinge", "slider"),
        }
        for key, meant in kinds.items():
            if key in self.model_fields_set and getattr(self, key) is not None and self.kind not in meant:
                raise ValueError(f"{key} has no meaning for a {self.kind}, only for {' or '.join(meant)}; remove it")

    def _check_motor(self, motor: MotorParameters) -> None:
        limit, other = ("max_torque", "max_force") if self.kind == "hinge" else ("max_force", "max_torque")
        aim, wrong = ("angle_deg", "position") if self.kind == "hinge" else ("position", "angle_deg")
        unit = "N m" if self.kind == "hinge" else "N"
        if getattr(motor, limit) is None:
            raise ValueError(f"the motor has no {limit}; give the most that it can [{unit}], or it could do anything")
        if getattr(motor, other) is not None:
            raise ValueError(f"the motor of a {self.kind} has a {limit}, no {other}; remove that")
        if getattr(motor, wrong) is not None:
            raise ValueError(f"the motor of a {self.kind} has {aim}, no {wrong}; use that")
        limits = self.limits_deg if self.kind == "hinge" else self.limits
        goal = getattr(motor, aim)
        if limits is not None and goal is not None and not limits[0] <= goal <= limits[1]:
            raise ValueError(f"the motor's {aim} {goal:g} is beyond the limits {limits[0]:g} to {limits[1]:g}")


class JointProblem(NamedTuple):
    """What is wrong with a joint of a scene: its number, the key (empty for all of it), and a sentence."""

    number: int
    key: str
    sentence: str

    @property
    def text(self) -> str:
        """The sentence with its key."""
        return f"{self.key} {self.sentence}".strip()


def points_of(joint: JointParameters, bodies: Sequence[RigidBodyParameters]) -> tuple[Vector3, Vector3]:
    """The points of a joint on its first and on its second body at the start [m]; bodies that it names are there."""
    if joint.kind in RIGID_KINDS:
        point = joint.anchor
        if point is None:
            point = next(_place_of(body) for body in bodies if body.name == joint.between[0])
        return point, point
    if joint.anchors is not None:
        return joint.anchors
    by_name = {body.name: body for body in bodies}
    first, second = (_place_of(by_name[name]) for name in joint.between)
    return first, second


def _place_of(body: RigidBodyParameters) -> Vector3:
    """Where the origin of a body's shape is at the start [m]; that of one that a file animates is in the file."""
    if body.shape.type != "animation":
        return body.position
    x, y, z = path_of(body).at(0.0).position.tolist()
    return x, y, z


def joint_problems(
    joints: Sequence[JointParameters], bodies: Sequence[RigidBodyParameters], cloths: Collection[str] = ()
) -> Iterator[JointProblem]:
    """Joints that cannot be, of bodies that may not be there; cloths by name."""
    kinds = {body.name: body.kind for body in bodies}
    broken = {name for body in bodies if body.whole is not None for name in (body.name, body.whole, body.group)}
    names: dict[str, int] = {}
    held: dict[frozenset[str], list[JointParameters]] = {}
    for number, joint in enumerate(joints):
        if joint.name in names:
            yield JointProblem(number, "name", f'"{joint.name}" is taken by joint[{names[joint.name]}]; take another')
        names.setdefault(joint.name, number)
        held_cloths = [name for name in joint.between if name in cloths]
        if breaking := [name for name in joint.between if name in broken]:
            what = "a piece of a body" if breaking[0] in kinds else "a body"
            sentence = f'holds "{breaking[0]}", {what} that breaks, which no joint can; remove the joint or breaks'
            yield JointProblem(number, "between", sentence)
            continue
        if unknown := [name for name in joint.between if name not in kinds and name not in held_cloths]:
            whole = [name for name in kinds if name not in broken]
            known = f"rigid bodies are {', '.join(whole)}" if whole else "add [[rigid]]"
            known += f"; cloths are {', '.join(cloths)}" if cloths else ""
            yield JointProblem(number, "between", f'names no rigid body with "{unknown[0]}"; {known}')
            continue
        if held_cloths:
            yield from _problems_with_cloth(number, joint, kinds, held_cloths, bodies)
            continue
        if all(kinds[name] != "dynamic" for name in joint.between):
            told = " and ".join(f'"{name}" is {kinds[name]}' for name in joint.between)
            sentence = f'cannot move: {told}, which no force moves; make one kind = "dynamic"'
            yield JointProblem(number, "between", sentence)
            continue
        if joint.kind in RIGID_KINDS:
            # All that stands is one; "" is the world.
            pair = frozenset("" if kinds.get(name) in (None, "static") else name for name in (*joint.between, "")[:2])
            for other in held.setdefault(pair, []):
                if {joint.kind, other.kind} != {"ball"}:
                    yield JointProblem(
                        number,
                        "between",
                        f'are held by joint "{other.name}" already, and two that hold the same bodies fight; remove '
                        "one, or use ball joints alone",
                    )
                    break
            held[pair].append(joint)
            continue
        yield from _problems_of_a_line(number, joint, bodies)


def _problems_with_cloth(
    number: int,
    joint: JointParameters,
    kinds: Mapping[str, str],
    cloths: Sequence[str],
    bodies: Sequence[RigidBodyParameters],
) -> Iterator[JointProblem]:
    """Of a joint that names cloths: one end is a dynamic body, and a point of cloth has no directions."""
    led = [name for name in joint.between if kinds.get(name, "dynamic") != "dynamic"]
    if len(cloths) == 2:
        yield JointProblem(number, "between", f'joins the cloths "{cloths[0]}" and "{cloths[1]}"; join both to a body')
    elif len(joint.between) == 1 or led:
        other = f'"{led[0]}", which is {kinds[led[0]]}' if led else "the world"
        pin = "[[cloth.pin]] with such keyframes" if led and kinds[led[0]] == "kinematic" else "[[cloth.pin]]"
        yield JointProblem(number, "between", f'joins the cloth "{cloths[0]}" to {other}; hold it there by a {pin}')
    elif joint.kind in RIGID_KINDS and joint.kind != "ball":
        yield JointProblem(
            number, "kind", f'is a {joint.kind} at the cloth "{cloths[0]}", a point of which has no directions; use a '
            "ball, a distance, a spring or a rope",
        )  # fmt: skip
    elif joint.cone_deg is not None:
        yield JointProblem(
            number, "cone_deg", f'is about an axis of the cloth "{cloths[0]}", a point of which has no directions; '
            "remove axis and cone_deg",
        )  # fmt: skip
    elif joint.kind != "ball":
        if joint.anchors is None:
            yield JointProblem(number, "", f"anchors are missing; a {joint.kind} to a cloth needs its two points")
        else:
            yield from _problems_of_a_line(number, joint, bodies)


def _problems_of_a_line(
    number: int, joint: JointParameters, bodies: Sequence[RigidBodyParameters]
) -> Iterator[JointProblem]:
    if joint.anchors is None and len(joint.between) == 1:
        yield JointProblem(number, "", f"anchors are missing; a {joint.kind} to the world needs its two points")
        return
    distance = math.dist(*points_of(joint, bodies))
    if joint.kind != "rope" and distance < NO_LENGTH:
        yield JointProblem(
            number, "anchors" if joint.anchors else "", f"its two points are one, and a {joint.kind} between them has "
            'no direction; move them apart, or use kind = "ball"',
        )  # fmt: skip
    if joint.length is None:
        if joint.kind == "rope" and distance < NO_LENGTH:
            yield JointProblem(number, "", "its two points are one; give the rope a length")
        return
    if joint.kind == "rope" and joint.length < distance * (1.0 - LENGTH_ROUNDING):
        yield JointProblem(
            number, "length", f"{joint.length:g} m excludes the start, where the points are {distance:.6g} m apart; "
            "make it longer, or move them together",
        )  # fmt: skip
    if joint.kind == "distance" and abs(joint.length - distance) > LENGTH_ROUNDING * distance:
        yield JointProblem(
            number, "length", f"must be that at the start, where the points are {distance:.6g} m apart, got "
            f"{joint.length:g} m; omit it, or move them",
        )  # fmt: skip
