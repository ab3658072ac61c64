"""The projection alone: what divergence one leaves, in how many iterations, and how exact its field is."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from benchmarks.validation.checks import CaseResult, Check, fitted_order
from benchmarks.validation.smoke_boxes import Array
from sim.domain import Face
from sim.shapes import build_solid
from sim.shapes.parameters import Placement, SphereShape
from sim.smoke.grid import SmokeGrid

SOLVERS = ("smoke",)

TOLERANCE, MAX_ITERATIONS = 1e-5, 50
"""Largest max|div u| h / max|u|, as of a job's smoke by default, and where a projection gives up."""

ROUGH_CELLS, EXACT_CELLS = (32, 64), (16, 32, 64)
"""Across the unit box with the rough flow, and with the one that has an exact projection."""

EXACT_TOLERANCE = 3e-6
"""Of the latter: far below the error of the differences at 64 cells across."""

OPEN: tuple[Face, ...] = ("x-", "x+", "y-", "y+", "z+")
ALL_OPEN: tuple[Face, ...] = (*OPEN, "z-")
SIDES: dict[str, tuple[Face, ...]] = {"closed box": (), "open box": OPEN}
BOUNDS = ("walls", "open sides")
"""Of the box with the exact projection."""

BALL = Placement(shape=SphereShape(type="sphere", radius=0.2), position=(0.5, 0.5, 0.5))


def run(solver: str, *, quick: bool = False) -> CaseResult:
    """A rough flow in open and closed boxes, with a ball and without; refinement against an exact projection."""
    rough_cells, exact_cells = (ROUGH_CELLS[:1], EXACT_CELLS[:2]) if quick else (ROUGH_CELLS, EXACT_CELLS)
    # Most of the time of a small grid is that of compiling its kernels: the quick case has fewer of them.
    bodies, bounds = ((True,), BOUNDS[:1]) if quick else ((False, True), BOUNDS)
    checks: list[Check] = []
    series: dict[str, Any] = {"cells": list(exact_cells)}
    most = 0
    for sides in SIDES:
        for ball in bodies:
            name = f"{sides} with a ball" if ball else sides
            histories = [_project_rough(n, sides, ball=ball) for n in rough_cells]
            checks.append(
                Check(f"max|div u| h / max|u|, {name}", max(each[-1] for each in histories),
                      0.0, TOLERANCE, "required, and the solver stops there; summed anew in double precision")
            )  # fmt: skip
            series |= {f"left, {name}, {n}": each for n, each in zip(rough_cells, histories, strict=True)}
            most = max(most, *(len(each) - 1 for each in histories))
    checks.append(
        Check("most iterations of a projection", most, 5.0, 1.0,
              "measured, at every resolution; conjugate gradients alone take twice as many with each refinement")
    )  # fmt: skip
    spacings = [1.0 / n for n in exact_cells]
    for name in bounds:
        errors = [_projection_error(n, closed=name == "walls") for n in exact_cells]
        series[f"errors, {name}"] = errors
        checks.append(
            Check(f"order of the projected velocity between {name}", fitted_order(spacings, errors), 2.0, 0.1,
                  "central differences; rms, in which the half cells at open sides count little")
        )  # fmt: skip
    settings = {"tolerance": TOLERANCE, "rough_cells": rough_cells, "ball_radius_m": BALL.shape.radius}
    return CaseResult("smoke-projection", solver, settings, checks, series)


def count_iterations(n: int, sides: str, *, ball: bool) -> tuple[int, float]:
    """Project a jet with noise once in a box n cells across: iterations, and max|div u| h / max|u| that they leave."""
    grid = _grid(n, SIDES[sides], ball=ball)
    left, iterations = _Bench(grid, TOLERANCE).project(_jet_with_noise(grid), MAX_ITERATIONS)
    return iterations, left


def _project_rough(n: int, sides: str, *, ball: bool) -> list[float]:
    """max|div u| h / max|u| of a jet with noise before its projection and after each iteration of it."""
    grid = _grid(n, SIDES[sides], ball=ball)
    flow = _jet_with_noise(grid)
    bench = _Bench(grid, TOLERANCE)
    left = [bench.project(flow, 0)[0]]
    while left[-1] > TOLERANCE and len(left) <= MAX_ITERATIONS:
        left.append(bench.project(flow, len(left))[0])
    return left


def _jet_with_noise(grid: SmokeGrid) -> list[Array]:
    """Velocities by axis at the middles of faces, all of them alike but for the noise."""
    random = np.random.default_rng(1)
    flow = []
    for axis in range(3):
        distance = ((grid.face_centres(axis) - 0.5) ** 2).sum(axis=1)
        flow.append(np.exp(-distance / 0.02) + 0.1 * random.standard_normal(len(distance)))
    return flow


def _projection_error(n: int, *, closed: bool) -> float:
    """Root mean square of what a projection differs from the exact one by, over that of the latter.

    The flow is v + grad p, where div v = 0 and no v crosses a wall. Between walls p = cos(pi x) cos(pi y) cos(2 pi z)
    has no slope across them; where all sides are open, sin in place of cos vanishes on them. v is the same: no
    condition holds for it there.
    """
    grid = _grid(n, () if closed else ALL_OPEN, ball=False)
    given, exact = [], []
    for axis in range(3):
        positions = grid.face_centres(axis)
        exact.append(_without_divergence(positions)[:, axis])
        given.append(exact[-1] + _slope(positions, axis, closed=closed))
    bench = _Bench(grid, EXACT_TOLERANCE)
    bench.project(given, MAX_ITERATIONS)
    errors = np.concatenate([(found.ravel() - each) for found, each in zip(bench.faces(), exact, strict=True)])
    return float(np.sqrt((errors**2).mean() / (np.concatenate(exact) ** 2).mean()))


def _without_divergence(positions: Array) -> Array:
    """Of unlike wave lengths, as differences of like ones cancel to rounding on a staggered grid."""
    x, y, z = math.pi * positions.T
    along, across = 2.0 * np.sin(x) * np.cos(2.0 * y), -np.cos(x) * np.sin(2.0 * y)
    return np.stack([along * np.cos(z), across * np.cos(z), np.zeros_like(x)], axis=1)


def _slope(positions: Array, axis: int, *, closed: bool) -> Array:
    """Derivative of p along an axis [m/s]."""
    wave = math.pi * np.array([1.0, 1.0, 2.0])
    phase = positions * wave
    parts = np.cos(phase) if closed else np.sin(phase)
    parts[:, axis] = wave[axis] * (-np.sin(phase[:, axis]) if closed else np.cos(phase[:, axis]))
    product: Array = parts.prod(axis=1)
    return product


def _grid(n: int, open_faces: tuple[Face, ...], *, ball: bool) -> SmokeGrid:
    cells = (n, n, n)
    empty = SmokeGrid((0.0, 0.0, 0.0), 1.0 / n, cells, frozenset(open_faces), np.zeros(cells, bool))
    if not ball:
        return empty
    return SmokeGrid(empty.origin, empty.cell_size, cells, empty.open_faces, empty.cells_inside(build_solid(BALL)))


class _Bench:
    """A projection and the velocity that it works on."""

    def __init__(self, grid: SmokeGrid, tolerance: float) -> None:
        import taichi as ti

        from sim.smoke.obstacles import Obstacles
        from sim.smoke.projection import PressureProjection

        self._grid = grid
        self._fields = tuple(ti.field(ti.f32, shape=grid.size) for _ in range(3))
        self._projection = PressureProjection(
            Obstacles(grid), self._fields, tolerance=tolerance, max_iterations=MAX_ITERATIONS
        )

    def project(self, flow: list[Array], iterations: int) -> tuple[float, int]:
        """Project a flow, given at the middles of faces, in so many iterations at most.

        Returns:
            The divergence that is left, max|div u| h / max|u|, in double precision, and the iterations it took.
        """
        grid = self._grid
        for axis, (field, values) in enumerate(zip(self._fields, flow, strict=True)):
            open_values = values.reshape(grid.face_shape(axis)) * (grid.open_area[axis] > 0.0)
            field.from_numpy(grid.pad(open_values.astype(np.float32)).ravel())
        self._projection._max_iterations = iterations
        report = self._projection.project()
        faces = self.faces()
        divergence = sum(np.diff(face, axis=axis) for axis, face in enumerate(faces))[~grid.solid]
        left = float(np.abs(divergence).max() / max(np.abs(face).max() for face in faces))
        return left, report.iterations

    def faces(self) -> list[Array]:
        """Velocities by axis, `face_shape(axis)`."""
        grid = self._grid
        shapes = [grid.face_shape(axis) for axis in range(3)]
        return [
            grid.trim(field.to_numpy(), shape).astype(np.float64)
            for field, shape in zip(self._fields, shapes, strict=True)
        ]
