"""Small cloths for the tests."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters
from sim.cloth.solver import ClothSolver
from sim.core.domain import DomainParameters
from validation.sheet_energy import elastic_energy

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
    return elastic_energy(solver, solver.state.positions())


def energy(solver: ClothSolver) -> float:
    """Of motion, springs and height [J], in float64."""
    mass = solver.state.mass.to_numpy().astype(np.float64)
    velocity = solver.state.velocity.to_numpy().astype(np.float64)
    kinetic = 0.5 * float(mass @ (velocity**2).sum(axis=1))
    return kinetic + spring_energy(solver) - float(mass @ (solver.state.positions() @ np.asarray(solver.gravity)))


def irregular_square(
    size: float | tuple[float, float], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """A square or rectangle about the origin of triangles of all shapes, with a vertex at the origin.

    Args:
        size: length of its sides [m].
        spacing: of its vertices, about [m].
    """
    from scipy.spatial import Delaunay

    sides = np.array(size if isinstance(size, tuple) else (size, size))
    counts = np.round(sides / spacing).astype(int)
    x, y = (np.linspace(-0.5, 0.5, count + 1) * side for count, side in zip(counts, sides, strict=True))
    border = [(a, b) for b in (y[0], y[-1]) for a in x] + [(a, b) for a in (x[0], x[-1]) for b in y[1:-1]]
    many = int(counts.max()) + 2
    j, i = (each.ravel() for each in np.mgrid[-many : many + 1, -many : many + 1])
    points = spacing * np.stack([i + 0.5 * (j % 2), j * np.sqrt(0.75)], axis=1)
    points += spacing * np.random.default_rng(0).uniform(-0.2, 0.2, points.shape)
    points[(i == 0) & (j == 0)] = 0.0
    points = points[(np.abs(points) < 0.5 * sides - 0.45 * spacing).all(axis=1)]
    vertices = np.concatenate([border, points])
    triangles = Delaunay(vertices).simplices
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    area = 0.5 * np.abs(np.linalg.det(np.stack([b - a, c - a], axis=1)))
    vertices = np.concatenate([vertices, np.zeros((len(vertices), 1))], axis=1)
    return vertices, triangles[area > 0.02 * spacing**2].astype(np.int32)
