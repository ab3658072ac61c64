"""Live parameters: keys of a job that can be changed while it runs, by kind of body, and how solvers take them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from sim.cloth.parameters import substeps_of
from sim.soft.materials import LAW_KEYS

Value = float | bool | tuple[float, float, float]
Widget = Literal["number", "decades", "whole", "switch", "vector"]

SUBSTEPS_RANGE = 2, 60
"""Fewest and most substeps a frame, if the job does not ask for others."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a job that can be changed while it runs."""

    name: str  # unique, as `--set` would write it: "cloth.sheet.friction"
    label: str  # on the page, with the unit
    folder: str  # its heading
    paths: tuple[KeyPath, ...]  # keys of the job that it stands for; several where bodies share the value
    # a slider ("decades": over the powers of ten, "whole": of whole numbers), a switch, or three numbers
    widget: Widget
    # ends of the range, in the key's unit
    low: float
    high: float
    start: Value  # the job's value

    @classmethod
    def within(
        cls,
        name: str,
        label: str,
        folder: str,
        widget: Widget,
        *paths: KeyPath,
        ends: tuple[float, float],
        start: Value,
    ) -> Parameter:
        """A parameter whose range has room for where it starts."""
        numbers = () if widget == "switch" else start if isinstance(start, tuple) else (float(start),)
        low, high = min((ends[0], *numbers)), max((ends[1], *numbers))
        if widget == "decades" and low <= 0.0:
            low = ends[0]
        if widget == "vector":
            low, high = min(low, -high), max(high, -low)
        if widget == "whole":
            low, high = int(low), int(high)
        return cls(name, label, folder, paths, widget, low, high, start)

    def checked(self, value: object) -> Value:
        """The value, as one of this parameter's; where it starts is always one.

        Raises ValueError: it is none, or out of range.
        """
        if self.widget == "switch":
            return bool(value)
        if value == self.start:  # a bend stiffness of 0 has no place among powers of ten
            return self.start
        numbers = value if isinstance(value, tuple | list) else (value,)
        if len(numbers) != (3 if self.widget == "vector" else 1) or not all(
            isinstance(each, int | float) and math.isfinite(each) and self.low <= each <= self.high for each in numbers
        ):
            raise ValueError(f"{self.name} must lie between {self.low:g} and {self.high:g}, got {value}")
        if self.widget == "vector":
            return (float(numbers[0]), float(numbers[1]), float(numbers[2]))
        return round(numbers[0]) if self.widget == "whole" else float(numbers[0])


@dataclass(frozen=True)
class LiveParameters:
    """Live parameters of one kind of body."""

    # those of a job that has such bodies, as it is simulated and as it was read
    of: Callable[[Job, Job], Iterator[Parameter]]
    solver: Callable[[Job], str]  # name of the kind's solver in the world of a job
    # gives that solver another value from the next frame on: the solver, the name of a body, or of the first one if
    # they share the value, the key, the value, and the value before
    set: Callable[[Any, str, str, Any, Any], None]
    # gives it another gravity [m/s²]; None: gravity is fixed where there is a body of this kind
    set_gravity: Callable[[Any, Any], None] | None


Row = tuple[str, str, Widget, float, float]
"""A key of a body, its label, its widget, and the ends of its range."""


def _of_body(kind: str, heading: str, number: int, body: Any, rows: Iterable[Row]) -> Iterator[Parameter]:
    """Parameters of a body: those of the rows' keys that have a value."""
    for key, label, widget, low, high in rows:
        value = getattr(body, key)
        if value is not None:
            called = getattr(body, "group", body.name)  # a group's bodies share the value
            name, folder, path = f"{kind}.{called}.{key}", f"{heading} {called}", (kind, number, key)
            yield Parameter.within(name, label, folder, widget, path, ends=(low, high), start=value)


# --- cloth ---

CLOTH_ROWS: tuple[Row, ...] = (
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


def _of_cloth(job: Job, written: Job) -> Iterator[Parameter]:
    """Substeps, which explicit springs dictate, and the keys above."""
    if job.cloth[0].integrator == "xpbd":
        paths = tuple(("cloth", number, "substeps") for number in range(len(job.cloth)))
        count, asked = (substeps_of(each.cloth) for each in (job, written))
        ends = min(SUBSTEPS_RANGE[0], asked), max(SUBSTEPS_RANGE[1], asked)
        yield Parameter.within("cloth.substeps", "substeps a frame", "Scene", "whole", *paths, ends=ends, start=count)
    for number, cloth in enumerate(job.cloth):
        yield from _of_body("cloth", "Cloth", number, cloth, CLOTH_ROWS)


def _set_cloth(solver: Any, body: str, key: str, value: Any, _before: Any) -> None:
    if key == "substeps":
        solver.take_substeps(value)
    else:
        solver.change(body, **{key: value})


CLOTH_LIVE = LiveParameters(
    of=_of_cloth,
    solver=lambda _job: "cloth",
    set=_set_cloth,
    set_gravity=lambda solver, value: setattr(solver, "gravity", value),
)


# --- rigid bodies ---

DENSITY: Row = ("density", "density [kg/m³]", "decades", 10.0, 2.0e4)
FRICTION: Row = ("friction", "friction", "number", 0.0, 2.0)
RESTITUTION: Row = ("restitution", "restitution", "number", 0.0, 1.0)


def _of_rigid(job: Job, _written: Job) -> Iterator[Parameter]:
    """Density, except with ballast, whose share in the mass is fixed, and the numbers of surfaces that mean something.

    Those are the same of a job and its live one: beside a fluid, bodies that rest are fixed when no other moves.
    """
    falls = any(body.kind == "dynamic" for body in job.rigid)
    rubs = falls or (bool(job.cloth) and (not job.fluid or bool(job.moving_bodies)))
    tables = {body.table: body for body in reversed(job.rigid)}
    for table, body in sorted(tables.items()):
        rows = [DENSITY] * (not body.ballast) + [FRICTION] * rubs + [RESTITUTION] * falls
        yield from _of_body("rigid", "Body", table, body, rows)


def _set_rigid(solver: Any, body: str, key: str, value: Any, before: Any) -> None:
    if key == "density":
        solver.scale_mass(body, value / before)
    else:
        solver.set_surface(body, **{key: value})


RIGID_LIVE = LiveParameters(
    of=_of_rigid,
    solver=lambda _job: "rigid",
    set=_set_rigid,
    set_gravity=lambda solver, value: solver.set_gravity(value),
)


# --- fluids ---

VISCOSITY: Row = ("viscosity", "viscosity [m²/s]", "decades", 1.0e-7, 1.0)


def _of_fluid(job: Job, _written: Job) -> Iterator[Parameter]:
    """Steps, if the job does not fix them, and viscosities."""
    if job.fluid[0].dt == "adaptive":
        paths = tuple(("fluid", number, "cfl") for number in range(len(job.fluid)))
        label, cfl = "steps of fluids (cfl)", job.fluid[0].cfl
        yield Parameter.within("fluid.cfl", label, "Scene", "number", *paths, ends=(0.1, 2.0), start=cfl)
    for number, fluid in enumerate(job.fluid):
        yield from _of_body("fluid", "Fluid", number, fluid, [VISCOSITY])


def _set_fluid(solver: Any, body: str, key: str, value: Any, _before: Any) -> None:
    if key == "cfl":
        solver.set_cfl(value)
    else:
        solver.set_viscosity(body, value)


FLUID_LIVE = LiveParameters(
    of=_of_fluid,
    solver=lambda job: "+".join(fluid.name for fluid in job.fluid),
    set=_set_fluid,
    set_gravity=None,  # a fluid is sized for gravity when it is built
)


# --- soft matter ---

MODULUS: Row = ("young_modulus", "Young's modulus [Pa]", "decades", 1.0e3, 1.0e6)
SOFT_ROWS: tuple[Row, ...] = (
    ("friction_angle_deg", "angle of friction [degrees]", "number", 1.0, 60.0),
    ("cohesion", "cohesion [Pa]", "number", 0.0, 2.0e3),
    ("yield_stress", "yield stress [Pa]", "decades", 10.0, 1.0e5),
    ("viscosity", "viscosity [Pa s]", "number", 0.0, 100.0),
    ("hardening", "hardening", "number", 0.0, 20.0),
)


def _of_soft(job: Job, _written: Job) -> Iterator[Parameter]:
    """What each body is made of, as far as its law knows it."""
    for number, body in enumerate(job.soft):
        rows = [MODULUS, *(row for row in SOFT_ROWS if LAW_KEYS[row[0]] == body.row.law)]
        made_of = body.model_copy(update={key: body.value(key) for key, *_ in rows})
        yield from _of_body("soft", "Soft matter", number, made_of, rows)


SOFT_LIVE = LiveParameters(
    of=_of_soft,
    solver=lambda _job: "soft",
    set=lambda solver, body, key, value, _before: solver.change(body, **{key: value}),
    set_gravity=lambda solver, value: setattr(solver, "gravity", value),
)
