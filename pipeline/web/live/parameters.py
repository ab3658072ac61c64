"""Live parameters: keys of the job that can be changed while it runs, their ranges, and how solvers take them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from pipeline.job.overrides import Override
from pipeline.model.positions import KeyPath
from sim.cloth.parameters import DEFAULT_SUBSTEPS, ClothParameters

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.core.world import World

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
    # number: a slider; decades: one over the powers of ten; whole: of whole numbers; switch; vector: three
    widget: Widget
    low: float  # ends of the range, in the key's unit
    high: float  # ends of the range, in the key's unit
    start: Value  # the job's value

    def checked(self, value: object) -> Value:
        """The value, as one of this parameter's; where it starts is always one.

        Raises:
            ValueError: it is none, or out of range.
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


def _parameter(
    name: str, label: str, folder: str, widget: Widget, *paths: KeyPath, ends: tuple[float, float], start: Value
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
    return Parameter(name, label, folder, paths, widget, low, high, start)


# --- by kind of body ---


@dataclass(frozen=True)
class KindParameters:
    """Live parameters of one kind of body."""

    of: Callable[[Job, Job], Iterator[Parameter]]  # those of a job as it is simulated and as it was read
    solver: Callable[[Job], str]  # name of the kind's solver in the world of a job
    # gives that solver another value from the next frame on: solver, job, parameter, value, value before
    set: Callable[[Any, Job, Parameter, Any, Any], None]
    # gives it another gravity [m/s²]; None: it is fixed where there is a body of this kind
    set_gravity: Callable[[Any, Any], None] | None


_CLOTH: tuple[tuple[str, str, Widget, float, float], ...] = (
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
    if job.cloth and job.cloth[0].integrator == "xpbd":
        paths = tuple(("cloth", number, "substeps") for number in range(len(job.cloth)))
        count, asked = (each.cloth[0].substeps or DEFAULT_SUBSTEPS for each in (job, written))
        ends = min(SUBSTEPS_RANGE[0], asked), max(SUBSTEPS_RANGE[1], asked)
        yield _parameter("cloth.substeps", "substeps a frame", "Scene", "whole", *paths, ends=ends, start=count)
    for number, cloth in enumerate(job.cloth):
        for key, label, widget, low, high in _CLOTH:
            value = getattr(cloth, key)
            if value is not None:
                path = ("cloth", number, key)
                name, folder = f"cloth.{cloth.name}.{key}", f"Cloth {cloth.name}"
                yield _parameter(name, label, folder, widget, path, ends=(low, high), start=value)


def _set_cloth(solver: Any, job: Job, parameter: Parameter, value: Any, _before: Any) -> None:
    key = str(parameter.paths[0][-1])
    if key == "substeps":
        solver.take_substeps(value)
    else:
        solver.change(job.cloth[int(parameter.paths[0][1])].name, **{key: value})


def _of_rigid(job: Job, _written: Job) -> Iterator[Parameter]:
    """Density, except with ballast, whose share in the mass is fixed, and the numbers of surfaces that mean something.

    Those are the same of a job and its live one: beside a fluid, bodies that rest are fixed when no other moves.
    """
    falls = any(body.kind == "dynamic" for body in job.rigid)
    rubs = falls or (bool(job.cloth) and (not job.fluid or bool(job.moving_bodies)))
    for number, body in enumerate(job.rigid):
        name, folder = f"rigid.{body.name}", f"Body {body.name}"
        if body.density is not None and not body.ballast:
            ends, path = (10.0, 2.0e4), ("rigid", number, "density")
            label = "density [kg/m³]"
            yield _parameter(f"{name}.density", label, folder, "decades", path, ends=ends, start=body.density)
        for key, high in [("friction", 2.0)] * rubs + [("restitution", 1.0)] * falls:
            path, start = ("rigid", number, key), getattr(body, key)
            yield _parameter(f"{name}.{key}", key, folder, "number", path, ends=(0.0, high), start=start)


def _set_rigid(solver: Any, job: Job, parameter: Parameter, value: Any, before: Any) -> None:
    body, key = job.rigid[int(parameter.paths[0][1])].name, str(parameter.paths[0][-1])
    if key == "density":
        solver.scale_mass(body, value / before)
    else:
        solver.set_surface(body, **{key: value})


def _of_fluid(job: Job, _written: Job) -> Iterator[Parameter]:
    """Steps, if the job does not fix them, and viscosities."""
    if job.fluid and job.fluid[0].dt == "adaptive":
        paths = tuple(("fluid", number, "cfl") for number in range(len(job.fluid)))
        label, cfl = "steps of fluids (cfl)", job.fluid[0].cfl
        yield _parameter("fluid.cfl", label, "Scene", "number", *paths, ends=(0.1, 2.0), start=cfl)
    for number, fluid in enumerate(job.fluid):
        name, path = f"fluid.{fluid.name}.viscosity", ("fluid", number, "viscosity")
        label, folder, start = "viscosity [m²/s]", f"Fluid {fluid.name}", fluid.viscosity
        yield _parameter(name, label, folder, "decades", path, ends=(1.0e-7, 1.0), start=start)


def _set_fluid(solver: Any, job: Job, parameter: Parameter, value: Any, _before: Any) -> None:
    if parameter.paths[0][-1] == "cfl":
        solver.set_cfl(value)
    else:
        solver.set_viscosity(job.fluid[int(parameter.paths[0][1])].name, value)


PARAMETERS: Mapping[str, KindParameters] = {
    "cloth": KindParameters(
        _of_cloth, lambda _: "cloth", _set_cloth, lambda solver, value: setattr(solver, "gravity", value)
    ),
    "rigid": KindParameters(_of_rigid, lambda _: "rigid", _set_rigid, lambda solver, value: solver.set_gravity(value)),
    "fluid": KindParameters(  # which is sized for gravity when it is built
        _of_fluid, lambda job: "+".join(fluid.name for fluid in job.fluid), _set_fluid, None
    ),
}
"""Live parameters by kind of body; other kinds do not run live."""


# --- of a scene ---


def parameters_of(job: Job, *, written: Job | None = None) -> tuple[Parameter, ...]:
    """All live parameters of a job. A value outside of a range widens it.

    Args:
        job: as it is simulated.
        written: as it was read, if that differs: what it asks for can be had as well.
    """
    found = []
    if all(of_kind.set_gravity for kind, of_kind in PARAMETERS.items() if getattr(job, kind)):
        label, ends = "gravity [m/s²]", (-30.0, 30.0)
        found.append(_parameter("gravity", label, "Scene", "vector", ("gravity",), ends=ends, start=job.gravity))
    for of_kind in PARAMETERS.values():
        found += of_kind.of(job, written or job)
    return tuple(found)


def set_parameter(world: World, job: Job, parameter: Parameter, value: Value, *, before: Value) -> None:
    """Make the solvers step with another value from the next frame on.

    Raises:
        ValueError: a solver cannot have it; nothing has changed then.
    """
    solvers: Mapping[str, Any] = world.solvers
    kind = str(parameter.paths[0][0])
    if kind in PARAMETERS:
        of_kind = PARAMETERS[kind]
        of_kind.set(solvers[of_kind.solver(job)], job, parameter, value, before)
    else:
        for of_kind in PARAMETERS.values():
            solver = solvers.get(of_kind.solver(job))
            if of_kind.set_gravity is not None and solver is not None:
                of_kind.set_gravity(solver, value)
    world.tell_couplings()


def overrides_of(parameters: tuple[Parameter, ...], values: Mapping[str, Value]) -> list[Override]:
    """Changes of a job to these values, of those that differ from its own."""
    return [
        Override(path, list(value) if isinstance(value, tuple) else value, "live")
        for parameter in parameters
        if (value := values[parameter.name]) != parameter.start
        for path in parameter.paths
    ]


def with_substeps(cloth: tuple[ClothParameters, ...], count: int) -> tuple[ClothParameters, ...]:
    """The same cloths in another number of substeps a frame."""
    return tuple(each.model_copy(update={"substeps": count}) for each in cloth)
