"""Small scenes of rigid bodies that several tests share."""

import numpy as np

from sim.core.domain import DomainParameters
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.solver import RigidSolver

GRAVITY = 9.81
ROOM = DomainParameters(min=(-2, -2, 0), max=(2, 2, 4))
SPACE = DomainParameters(min=(-2, -2, 0), max=(2, 2, 4), open_faces=("x-", "x+", "y-", "y+", "z-", "z+"))


def body(name: str, shape: dict, position=None, **more) -> RigidBodyParameters:
    """A dynamic body of half the density of water, unless another kind is asked for."""
    if more.get("kind", "dynamic") == "dynamic":
        more = {"kind": "dynamic", "density": 500.0, **more}
    if position is not None:
        more["position"] = position
    return RigidBodyParameters(name=name, shape=shape, **more)


def cube(edge: float) -> dict:
    return {"type": "box", "size": (edge, edge, edge)}


def ball(radius: float) -> dict:
    return {"type": "sphere", "radius": radius}


def in_room(*bodies: RigidBodyParameters, obstacles=(), domain=ROOM) -> RigidSolver:
    """Under gravity between walls; the room has no lid."""
    return RigidSolver(bodies, obstacles=obstacles, domain=domain, gravity=(0, 0, -GRAVITY))


def in_space(*bodies: RigidBodyParameters) -> RigidSolver:
    """Without gravity and walls."""
    return RigidSolver(bodies, domain=SPACE, gravity=(0, 0, 0))


def advance(solver: RigidSolver, duration_s: float, dt: float | None = None) -> int:
    """Advance by the given or the stable step; the number of substeps."""
    end, count = 0.0, 0
    while end < duration_s - 1e-12:
        step = min(solver.stable_dt() if dt is None else dt, duration_s - end)
        solver.substep(step)
        end, count = end + step, count + 1
    return count


def energy(solver: RigidSolver) -> float:
    """Kinetic and potential energy [J]."""
    return sum(solver.diagnostics()[kind] for kind in ("kinetic_energy", "potential_energy"))


def totals(solver: RigidSolver, quantity: str) -> np.ndarray:
    """A vector among the diagnostics, (3,)."""
    diagnostics = solver.diagnostics()
    return np.array([diagnostics[f"{quantity}_{axis}"] for axis in "xyz"])
