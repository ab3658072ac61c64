"""Small cloths for the tests."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters
from sim.cloth.solver import ClothSolver
from sim.core.domain import DomainParameters

GRAVITY = 9.81
EARTH = (0.0, 0.0, -GRAVITY)
WEIGHTLESS = (0.0, 0.0, 0.0)
FRAMES_PER_SECOND = 60.0

SOFT: dict[str, Any] = {
    "mass_per_area": 0.2,
    "stretch_stiffness": 100.0,
    "shear_stiffness": 20.0,
    "bend_stiffness": 1e-5,
}
"""A cloth whose springs explicit steps of a few tenths of a millisecond bear."""

VACUUM: dict[str, Any] = {"air_density": 0.0}
UNDAMPED: dict[str, Any] = {"damping": 0.0, "bend_damping": 0.0}


def rectangle(size: tuple[float, float], counts: tuple[int, int]) -> dict[str, Any]:
    return {"type": "rectangle", "size": size, "counts": counts}


def cloth(name: str = "sheet", **keys: Any) -> ClothParameters:
    return ClothParameters.model_validate({"name": name, "shape": rectangle((0.2, 0.2), (9, 9)), **keys})


def solver_of(*cloths: ClothParameters, gravity: tuple[float, float, float] = EARTH) -> ClothSolver:
    return ClothSolver(cloths, domain=DomainParameters(), gravity=gravity, frames_per_second=FRAMES_PER_SECOND)


def advance(solver: ClothSolver, duration: float) -> float:
    """Advance by about so long; returns the time that was simulated [s]."""
    steps = max(1, round(duration / solver.stable_dt()))
    for _ in range(steps):
        solver.substep(solver.stable_dt())
    return steps * solver.stable_dt()


def momentum(solver: ClothSolver) -> NDArray[np.float64]:
    mass = solver.state.mass.to_numpy().astype(np.float64)
    total: NDArray[np.float64] = mass @ solver.state.velocity.to_numpy().astype(np.float64)
    return total


def angular_momentum(solver: ClothSolver) -> NDArray[np.float64]:
    mass = solver.state.mass.to_numpy().astype(np.float64)
    total: NDArray[np.float64] = mass @ np.cross(
        solver.state.positions(), solver.state.velocity.to_numpy().astype(np.float64)
    )
    return total


def spring_energy(solver: ClothSolver) -> float:
    return sum(springs.energy(solver.state.positions()) for springs in solver._springs)


def energy(solver: ClothSolver) -> float:
    """Of motion, springs and height [J], in float64."""
    mass = solver.state.mass.to_numpy().astype(np.float64)
    velocity = solver.state.velocity.to_numpy().astype(np.float64)
    kinetic = 0.5 * float(mass @ (velocity**2).sum(axis=1))
    return kinetic + spring_energy(solver) - float(mass @ (solver.state.positions() @ np.asarray(solver.gravity)))
