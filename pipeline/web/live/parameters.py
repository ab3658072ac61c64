"""Live parameters of a scene: those of its kinds of bodies, and gravity."""

from collections.abc import Mapping
from typing import Any

from pipeline.job.overrides import Override
from pipeline.kinds.base import Kind
from pipeline.kinds.live_parameters import Parameter, Value
from pipeline.kinds.table import KINDS
from pipeline.model.job import Job
from sim.core.world import World


def parameters_of(job: Job, *, written: Job | None = None) -> tuple[Parameter, ...]:
    """All live parameters of a job as it is simulated; what it asks for as it was `written` can be had as well."""
    # Rigid bodies come last, as there may be many.
    kinds = [kind.live for kind in reversed(KINDS.values()) if kind.bodies(job) and kind.live is not None]
    found = []
    if all(kind.set_gravity for kind in kinds):
        label, ends = "gravity [m/s²]", (-30.0, 30.0)
        found.append(Parameter.within("gravity", label, "Scene", "vector", ("gravity",), ends=ends, start=job.gravity))
    return (*found, *(parameter for kind in kinds for parameter in kind.of(job, written or job)))


def set_parameter(world: World, job: Job, parameter: Parameter, value: Value, *, before: Value) -> None:
    """Make the solvers step with another value from the next frame on.

    Raises ValueError: a solver cannot have it; nothing has changed then.
    """
    solvers: Mapping[str, Any] = world.solvers
    path = parameter.paths[0]
    for kind in KINDS.values():
        solver = None if kind.live is None else solvers.get(kind.live.solver(job))
        if kind.live is None or solver is None:
            continue
        if kind.name == path[0]:
            for body in _bodies_at(job, kind, int(path[1])):
                kind.live.set(solver, body, str(path[2]), value, before)
        elif parameter.name == "gravity" and kind.live.set_gravity is not None:
            kind.live.set_gravity(solver, value)
    world.tell_couplings()


def _bodies_at(job: Job, kind: Kind, table: int) -> list[str]:
    """Names of the bodies that a table of the job makes."""
    if kind is KINDS["rigid"]:
        return [body.name for body in job.rigid if body.table == table]
    return [kind.bodies(job)[table].name]


def overrides_of(parameters: tuple[Parameter, ...], values: Mapping[str, Value]) -> list[Override]:
    """Changes of a job to these values, of those that differ from its own."""
    return [
        Override(path, list(value) if isinstance(value, tuple) else value, "live")
        for parameter in parameters
        if (value := values[parameter.name]) != parameter.start
        for path in parameter.paths
    ]
