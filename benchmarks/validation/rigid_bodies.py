"""Builds the scenes of rigid bodies, and steps them as a film would."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.validation.stepping import landing_steps
from sim.domain import DomainParameters
from sim.rigid.parameters import RigidBodyParameters

if TYPE_CHECKING:
    from sim.rigid.solver import RigidSolver

GRAVITY = 9.81
EARTH = (0.0, 0.0, -GRAVITY)
WEIGHTLESS = (0.0, 0.0, 0.0)
HALL = DomainParameters(min=(-5.0, -5.0, 0.0), max=(5.0, 5.0, 10.0))


def body(name: str, shape: dict[str, Any], **parameters: Any) -> RigidBodyParameters:
    """A dynamic body of 700 kg/m³, smooth and without restitution, unless `parameters` say otherwise."""
    defaults = {"kind": "dynamic", "density": 700.0, "friction": 0.0, "restitution": 0.0}
    if parameters.get("kind", "dynamic") != "dynamic":
        del defaults["density"]
    return RigidBodyParameters.model_validate({**defaults, "name": name, "shape": shape, **parameters})


def make_bodies(
    bodies: Sequence[RigidBodyParameters],
    *,
    gravity: tuple[float, float, float] = EARTH,
    domain: DomainParameters = HALL,
    obstacles: Sequence[RigidBodyParameters] = (),
) -> RigidSolver:
    """The solver of these bodies."""
    from sim.rigid.solver import RigidSolver

    return RigidSolver(bodies, obstacles=obstacles, domain=domain, gravity=gravity)


def advance(solver: RigidSolver, duration: float, *, cuts: int = 1, largest_dt: float = math.inf) -> Iterator[float]:
    """Advance by a duration [s] and stop after each of so many equal parts; yields the time [s].

    Raises:
        RuntimeError: the state is not finite or runs away.
    """
    part = duration / cuts
    for cut in range(1, cuts + 1):
        for dt in landing_steps(part, lambda: min(solver.stable_dt(), largest_dt)):
            solver.substep(dt)
        quantity = solver.first_bad_quantity()
        if quantity is not None:
            raise RuntimeError(f"the bodies diverged by t = {cut * part:.4g} s: {quantity}")
        yield cut * part


def spin_energy(solver: RigidSolver) -> np.ndarray:
    """Kinetic energy of rotation of each body [J], (n,)."""
    energy: np.ndarray = 0.5 * np.einsum("ni,ni->n", solver.bodies.angular_momentum(), solver.bodies.angular_velocity)
    return energy
