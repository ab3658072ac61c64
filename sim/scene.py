"""The physical part of a job: the domain, gravity, and every body in it."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator

from sim.cloth.parameters import ClothParameters, conflict_in_one_air
from sim.core.domain import DomainParameters
from sim.core.parameters import Device, KeyRefusedError, Parameters, Vector3, composed
from sim.embers.parameters import EmberParameters
from sim.fluid.parameters import FluidParameters, tank_dye_conflict
from sim.forces.parameters import MOST_FORCES, Force, unknown_targets
from sim.rigid.groups import with_groups
from sim.rigid.joint_parameters import JointParameters
from sim.rigid.parameters import RigidBodyParameters
from sim.smoke.parameters import SmokeParameters, boxes_overlap
from sim.soft.parameters import SoftParameters


class SceneParameters(Parameters):
    """Everything that decides how the bodies move."""

    gravity: Vector3 = Field(default=(0.0, 0.0, -9.81), description="Gravity [m/s²].")
    domain: DomainParameters = Field(default=DomainParameters(), description="The box that the fluid lives in.")
    rigid: Annotated[tuple[RigidBodyParameters, ...], AfterValidator(with_groups)] = Field(
        default=(), description="Rigid bodies; a table with count makes many."
    )
    joint: tuple[JointParameters, ...] = Field(
        default=(), description="Joints between rigid bodies, to the world, or to points of cloths."
    )
    fluid: tuple[FluidParameters, ...] = Field(
        default=(), description="Particle fluids; several share one tank, and the keys that say how it is computed."
    )
    smoke: tuple[SmokeParameters, ...] = Field(default=(), description="Smoke.")
    cloth: tuple[ClothParameters, ...] = Field(
        default=(), description="Cloths; they collide with each other, and share the keys that say how they step."
    )
    soft: tuple[SoftParameters, ...] = Field(
        default=(),
        description="Sand, snow, jelly and clay, on one grid; they meet walls, rigid bodies, fluids, cloth and smoke.",
    )
    embers: tuple[EmberParameters, ...] = Field(default=(), description="Embers that the air of a smoke carries.")
    force: Annotated[tuple[Force, ...], Field(max_length=MOST_FORCES)] = Field(
        default=(), description="Forces from outside, and moving air, that act on all bodies, or on some."
    )
    device: Device = Field(
        default="auto",
        description="Where the simulation runs; auto: the fastest device that works, for rigid bodies alone the CPU.",
    )

    @property
    def chosen_device(self) -> Device:
        """The device; of rigid bodies alone the CPU instead of the fastest one, as a GPU takes longer for them."""
        return (
            "cpu"
            if self.device == "auto" and not (self.fluid or self.cloth or self.smoke or self.soft)
            else self.device
        )

    @model_validator(mode="before")
    @classmethod
    def _has_composed_names(cls, document: Any) -> Any:
        return composed(document)

    @model_validator(mode="after")
    def _has_dye_that_mixes(self) -> Self:
        if conflict := tank_dye_conflict(self.fluid):
            number, reason = conflict
            raise KeyRefusedError(("fluid", number), reason)
        return self

    @model_validator(mode="after")
    def _has_soft_matter_beside_cloth(self) -> Self:
        """Fluid has room for one kind of sheets, samples of soft matter or of cloth."""
        if self.soft and self.cloth and self.fluid:
            raise KeyRefusedError(
                ("soft", 0),
                "meets cloth, and meets fluid, but not both in one job: fluid would not feel the cloth; remove one of "
                "the three",
            )
        for number, cloth in enumerate(self.cloth):
            if self.soft and cloth.integrator == "explicit":
                raise KeyRefusedError(
                    ("cloth", number, "integrator"),
                    '"explicit" takes thousands of substeps a frame, which soft matter would have to share; '
                    'use "xpbd", or remove the soft matter',
                )
        return self

    @model_validator(mode="after")
    def _has_bodies_that_soft_matter_sticks_to(self) -> Self:
        bodies = {name for body in self.rigid for name in (body.name, body.group)}
        for number, soft in enumerate(self.soft):
            for entry, name in enumerate(soft.sticks_to):
                if name not in bodies:
                    raise KeyRefusedError(
                        ("soft", number, "sticks_to", entry), f'"{name}" is the name of no rigid body or group'
                    )
        return self

    @model_validator(mode="after")
    def _has_embers_in_smokes(self) -> Self:
        names = [smoke.name for smoke in self.smoke]
        for number, embers in enumerate(self.embers):
            if embers.smoke not in names:
                raise KeyRefusedError(
                    ("embers", number, "smoke"),
                    f'no smoke is named "{embers.smoke}"'
                    + (f"; smokes are {', '.join(names)}" if names else "; add [[smoke]]"),
                )
        return self

    @model_validator(mode="after")
    def _has_forces_on_bodies(self) -> Self:
        names = [body.name for body in (*self.fluid, *self.smoke, *self.cloth, *self.soft, *self.rigid)]
        names += [body.group for body in self.rigid]
        for number, entry, name in unknown_targets(self.force, names):
            raise KeyRefusedError(
                ("force", number, "only", entry),
                f'"{name}" is the name of no body, group, fluid, cloth, smoke or soft body',
            )
        return self

    @model_validator(mode="after")
    def _has_whole_boxes_beside_others(self) -> Self:
        others = {"fluid": self.fluid, "cloth": self.cloth, "soft matter": self.soft}
        other = next((name for name, there in others.items() if there), None)
        for number, smoke in enumerate(self.smoke):
            if smoke.grid != "box" and other is not None:
                raise KeyRefusedError(
                    ("smoke", number, "grid"),
                    f'"{smoke.grid}" is of a smoke in a job with {other}, which needs all cells of its box; '
                    'use "box", or remove one of both',
                )
        return self

    @model_validator(mode="after")
    def _has_guides_of_what_is_known_before(self) -> Self:
        """What a smoke pushes, or waits for, would go another way in its guide."""
        moving = any(body.kind == "dynamic" for body in self.rigid)
        others = {"fluid": self.fluid, "cloth": self.cloth, "soft matter": self.soft, "dynamic bodies": moving}
        other = next((name for name, there in others.items() if there), None)
        for number, smoke in enumerate(self.smoke):
            if smoke.upres > 1 and other is not None:
                raise KeyRefusedError(
                    ("smoke", number, "upres"),
                    f"{smoke.upres} is of a smoke in a job with {other}, which would move otherwise in the coarser "
                    "simulation that guides it; leave it out, or have nothing there but bodies that stand still or "
                    "follow keyframes",
                )
        return self

    @model_validator(mode="after")
    def _has_one_air(self) -> Self:
        if self.smoke and (conflict := conflict_in_one_air(self.cloth)):
            raise KeyRefusedError(*conflict)
        for number, smoke in enumerate(self.smoke):
            for other in self.smoke[:number]:
                if self.cloth and boxes_overlap(smoke.corners(self.domain), other.corners(self.domain)):
                    raise KeyRefusedError(
                        ("smoke", number),
                        f'its box and that of "{other.name}" overlap, and cloth can only be in one air; '
                        "give them min and max",
                    )
        return self
