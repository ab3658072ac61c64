"""What of a scene may be turned while it runs: which keys of the job, in which range, and how the solvers take them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from pipeline.job.overrides import Override
from pipeline.job.positions import KeyPath
from sim.cloth.parameters import DEFAULT_SUBSTEPS, ClothParameters

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.rigid.parameters import RigidBodyParameters
    from sim.world import World

Value = float | bool | tuple[float, float, float]
Kind = Literal["number", "decades", "whole", "switch", "vector"]

SUBSTEPS_RANGE = 2, 60
"""Fewest and most substeps a frame, if the job does not ask for others."""


@dataclass(frozen=True)
class Knob:
    """One thing to turn.

    Attributes:
        name: unique; how messages call it, as `--set` would: "cloth.sheet.friction".
        label: on the page, with the unit.
        folder: under which heading.
        paths: the keys of the job that it stands for; several where bodies share the value.
        kind: number: a slider; decades: one over the powers of ten; whole: of whole numbers; switch; vector: three.
        low, high: ends of the range, in the key's unit.
        start: the job's value.
    """

    name: str
    label: str
    folder: str
    paths: tuple[KeyPath, ...]
    kind: Kind
    low: float
    high: float
    start: Value

    def checked(self, value: object) -> Value:
        """The value, as one of this knob's kind; where it starts is always one.

        Raises:
            ValueError: it is none, or out of range.
        """
        if self.kind == "switch":
            return bool(value)
        if value == self.start:  # a bend stiffness of 0 has no place among powers of ten
            return self.start
        numbers = value if isinstance(value, tuple | list) else (value,)
        if len(numbers) != (3 if self.kind == "vector" else 1) or not all(
            isinstance(each, int | float) and math.isfinite(each) and self.low <= each <= self.high for each in numbers
        ):
            raise ValueError(f"{self.name} must lie between {self.low:g} and {self.high:g}, got {value}")
        if self.kind == "vector":
            return (float(numbers[0]), float(numbers[1]), float(numbers[2]))
        return round(numbers[0]) if self.kind == "whole" else float(numbers[0])


_CLOTH: tuple[tuple[str, str, Kind, float, float], ...] = (
    ("stretch_stiffness", "stretch stiffness [N/m]", "decades", 10.0, 1.0e5),
    ("shear_stiffness", "shear stiffness [N/m]", "decades", 1.0, 1.0e5),
    ("bend_stiffness", "bend stiffness [N m]", "decades", 1.0e-8, 1.0e-1),
    ("damping", "damping [s]", "number", 0.0, 0.05),
    ("bend_damping", "bend damping [s]", "number", 0.0, 0.1),
    ("mass_per_area", "mass [kg/m²]", "decades", 0.01, 10.0),
    ("friction", "friction", "number", 0.0, 2.0),
    ("self_collision", "collides with itself", "switch", 0.0, 1.0),
    ("wind", "wind [m/s]", "vector", -30.0, 30.0),
)


def knobs_of(job: Job, *, written: Job | None = None) -> tuple[Knob, ...]:
    """All that can be turned in the scene of a job. A value outside of a range widens it.

    Args:
        job: as it is simulated.
        written: as it was read, if that differs: what it asks for can be had as well.
    """
    found = list(_shared_knobs(job, written or job))
    for number, cloth in enumerate(job.cloth):
        for key, label, kind, low, high in _CLOTH:
            value = getattr(cloth, key)
            if value is not None:
                name, paths = f"cloth.{cloth.name}.{key}", (("cloth", number, key),)
                found.append(
                    _knob(name, label, f"Cloth {cloth.name}", paths=paths, kind=kind, ends=(low, high), start=value)
                )
    surface = _surface_keys(job)
    for number, body in enumerate(job.rigid):
        found += _knobs_of_body(number, body, surface)
    for number, fluid in enumerate(job.fluid):
        found.append(
            _knob(
                f"fluid.{fluid.name}.viscosity",
                "viscosity [m²/s]",
                f"Fluid {fluid.name}",
                paths=(("fluid", number, "viscosity"),),
                kind="decades",
                ends=(1.0e-7, 1.0),
                start=fluid.viscosity,
            )
        )
    return tuple(found)


def _surface_keys(job: Job) -> list[tuple[str, float]]:
    """Which numbers of bodies' surfaces mean something, and their largest values: the same of a job and its live one.

    Beside a fluid, bodies that rest are fixed when no other moves.
    """
    falls = any(body.kind == "dynamic" for body in job.rigid)
    rubs = falls or (bool(job.cloth) and (not job.fluid or bool(job.moving_bodies)))
    return [("friction", 2.0)] * rubs + [("restitution", 1.0)] * falls


def _knobs_of_body(number: int, body: RigidBodyParameters, surface: list[tuple[str, float]]) -> list[Knob]:
    """Density, except with ballast, whose share in the mass is fixed, and these numbers of its surface."""
    found, folder = [], f"Body {body.name}"
    if body.density is not None and not body.ballast:
        found.append(
            _knob(
                f"rigid.{body.name}.density",
                "density [kg/m³]",
                folder,
                paths=(("rigid", number, "density"),),
                kind="decades",
                ends=(10.0, 2.0e4),
                start=body.density,
            )
        )
    for key, high in surface:
        found.append(
            _knob(
                f"rigid.{body.name}.{key}",
                key,
                folder,
                paths=(("rigid", number, key),),
                kind="number",
                ends=(0.0, high),
                start=getattr(body, key),
            )
        )
    return found


def _shared_knobs(job: Job, written: Job) -> list[Knob]:
    """Gravity, which fluids are sized for when they are built; the steps of cloth, which explicit springs dictate, and
    those of fluids, if the job does not fix them."""
    found = []
    if not job.fluid:
        found.append(
            _knob(
                "gravity",
                "gravity [m/s²]",
                "Scene",
                paths=(("gravity",),),
                kind="vector",
                ends=(-30.0, 30.0),
                start=job.gravity,
            )
        )
    if job.cloth and job.cloth[0].integrator == "xpbd":
        paths = tuple(("cloth", number, "substeps") for number in range(len(job.cloth)))
        count, asked = (each.cloth[0].substeps or DEFAULT_SUBSTEPS for each in (job, written))
        ends = min(SUBSTEPS_RANGE[0], asked), max(SUBSTEPS_RANGE[1], asked)
        found.append(
            _knob("cloth.substeps", "substeps a frame", "Scene", paths=paths, kind="whole", ends=ends, start=count)
        )
    if job.fluid and job.fluid[0].dt == "adaptive":
        paths = tuple(("fluid", number, "cfl") for number in range(len(job.fluid)))
        label, cfl = "steps of fluids (cfl)", job.fluid[0].cfl
        found.append(_knob("fluid.cfl", label, "Scene", paths=paths, kind="number", ends=(0.1, 2.0), start=cfl))
    return found


def _knob(
    name: str,
    label: str,
    folder: str,
    *,
    paths: tuple[KeyPath, ...],
    kind: Kind,
    ends: tuple[float, float],
    start: Value,
) -> Knob:
    """A knob whose range has room for where it starts."""
    numbers = () if kind == "switch" else start if isinstance(start, tuple) else (float(start),)
    low, high = min((ends[0], *numbers)), max((ends[1], *numbers))
    if kind == "decades" and low <= 0.0:
        low = ends[0]
    if kind == "vector":
        low, high = min(low, -high), max(high, -low)
    if kind == "whole":
        low, high = int(low), int(high)
    return Knob(name, label, folder, paths, kind, low, high, start)


def turn(world: World, job: Job, knob: Knob, value: Value, *, before: Value) -> None:
    """Make the solvers step with another value from the next frame on.

    Raises:
        ValueError: a solver cannot have it; nothing has changed then.
    """
    solvers: Mapping[str, Any] = world.solvers
    first, key = knob.paths[0][0], knob.paths[0][-1]
    if first == "gravity":
        if "cloth" in solvers:
            solvers["cloth"].gravity = value
        if "rigid" in solvers:
            solvers["rigid"].set_gravity(value)
    elif first == "rigid":
        body = job.rigid[int(knob.paths[0][1])].name
        if key == "density":
            assert isinstance(value, float)
            assert isinstance(before, float)
            solvers["rigid"].scale_mass(body, value / before)
        else:
            solvers["rigid"].set_surface(body, **{str(key): value})
    elif first == "fluid":
        tank = solvers["+".join(fluid.name for fluid in job.fluid)]
        if key == "cfl":
            tank.set_cfl(value)
        else:
            tank.set_viscosity(job.fluid[int(knob.paths[0][1])].name, value)
    elif key == "substeps":
        solvers["cloth"].take_substeps(value)
    else:
        solvers["cloth"].change(job.cloth[int(knob.paths[0][1])].name, **{str(key): value})
    world.tell_couplings()


def overrides_of(knobs: tuple[Knob, ...], values: Mapping[str, Value]) -> list[Override]:
    """The changes that make the job that has these values, of those that differ from its own."""
    return [
        Override(path, list(value) if isinstance(value, tuple) else value, "live")
        for knob in knobs
        if (value := values[knob.name]) != knob.start
        for path in knob.paths
    ]


def with_substeps(cloth: tuple[ClothParameters, ...], count: int) -> tuple[ClothParameters, ...]:
    """The same cloths in another number of substeps a frame."""
    return tuple(each.model_copy(update={"substeps": count}) for each in cloth)
