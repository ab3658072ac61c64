"""The projection alone: what divergence one leaves, in how many iterations, and how exact its field is."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import Face
from sim.shapes.parameters import Placement, SphereShape
from sim.shapes.placement import build_solid
from sim.smoke.grid import SmokeGrid
from validation.cases import Case, Found
from validation.checks import CaseResult, Check, fitted_order
from validation.figures import SHADES, THEORY, draw_refinement, label_axes, make_panels
from validation.smoke_boxes import Array

TOLERANCE, MAX_ITERATIONS = 1e-5, 50  # of max|div u| h / max|u|, as of a job's smoke; where it gives up
EXACT_TOLERANCE = 3e-6  # of the latter: far below the error of the differences at 64 cells across

OPEN: tuple[Face, ...] = ("x-", "x+", "y-", "y+", "z+")
ALL_OPEN: tuple[Face, ...] = (*OPEN, "z-")
SIDES: dict[str, tuple[Face, ...]] = {"closed box": (), "open box": OPEN}
BOUNDS = ("walls", "open sides")  # of the exact projection
BALL = Placement(shape=SphereShape(type="sphere", radius=0.2), position=(0.5, 0.5, 0.5))


def find(_: str, rough_cells: Sequence[int], exact_cells: Sequence[int], bodies: Sequence[bool]) -> Found:
    """A rough flow in open and closed boxes; refinement against an exact projection."""
    checks: list[Check] = []
    series: dict[str, Any] = {"cells": list(exact_cells)}
    most = 0
    for sides in SIDES:
        for ball in bodies:
            name = f"{sides} with a ball" if ball else sides
            histories = [_project_rough(n, sides, ball=ball) for n in rough_cells]
            left = max(each[-1] for each in histories)
            reason = "required, and the solver stops there; summed anew in double precision"
            checks.append(Check(f"max|div u| h / max|u|, {name}", left, 0.0, TOLERANCE, reason))
            series |= {f"left, {name}, {n}": each for n, each in zip(rough_cells, histories, strict=True)}
            most = max(most, *(len(each) - 1 for each in histories))
    reason = "measured, at every resolution; conjugate gradients alone take twice as many with each refinement"
    checks.append(Check("most iterations of a projection", most, 5.0, 1.0, reason))
    reason = "central differences; rms, in which the half cells at open sides count little"
    spacings = [1.0 / n for n in exact_cells]
    for name in BOUNDS:
        errors = [_projection_error(n, closed=name == "walls") for n in exact_cells]
        series[f"errors, {name}"] = errors
        order = fitted_order(spacings, errors)
        checks.append(Check(f"order of the projected velocity between {name}", order, 2.0, 0.1, reason))
    return checks, series


def _project_rough(n: int, sides: str, *, ball: bool) -> list[float]:
    """max|div u| h / max|u| of a jet with noise before its projection and after each iteration of it."""
    grid = _grid(n, SIDES[sides], ball=ball)
    flow = _jet_with_noise(grid)
    bench = _Bench(grid, TOLERANCE)
    left = [bench.project(flow, 0)]
    while left[-1] > TOLERANCE and len(left) <= MAX_ITERATIONS:
        left.append(bench.project(flow, len(left)))
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
    return parts.prod(axis=1)


def _grid(n: int, open_faces: tuple[Face, ...], *, ball: bool) -> SmokeGrid:
    cells = (n, n, n)
    empty = SmokeGrid.of_cells((0.0, 0.0, 0.0), 1.0 / n, cells, frozenset(open_faces))
    return empty.with_solids([build_solid(BALL)]) if ball else empty


class _Bench:
    """A projection and the velocity that it works on."""

    def __init__(self, grid: SmokeGrid, tolerance: float) -> None:
        from sim.smoke.arrays import new_faces
        from sim.smoke.obstacles import Obstacles
        from sim.smoke.projection import PressureProjection

        self._grid = grid
        self._faces = new_faces(grid.size)
        self._obstacles = Obstacles(grid)
        self._projection = PressureProjection(
            self._obstacles, self._faces, tolerance=tolerance, max_iterations=MAX_ITERATIONS
        )

    def project(self, flow: list[Array], iterations: int) -> float:
        """Project a flow, given at the middles of faces, in so many iterations at most: max|div u| h / max|u| left."""
        grid = self._grid
        for axis, (array, values) in enumerate(zip(self._faces, flow, strict=True)):
            open_values = values.reshape(grid.face_shape(axis)) * (grid.open_area[axis] > 0.0)
            array.from_numpy(grid.pad(open_values.astype(np.float32)).ravel())
        self._projection._max_iterations = iterations
        self._projection.project()
        faces = self.faces()
        fluxes = faces
        if grid.has_solids:
            parts = (grid.trim(a.to_numpy(), grid.face_shape(n)) for n, a in enumerate(self._obstacles.solids.area))
            fluxes = [part * face for part, face in zip(parts, faces, strict=True)]
        divergence = np.sum([np.diff(flux, axis=axis) for axis, flux in enumerate(fluxes)], axis=0)
        return float(np.abs(divergence).max() / max(np.abs(face).max() for face in faces))

    def faces(self) -> list[Array]:
        """Velocities by axis, `face_shape(axis)`."""
        grid = self._grid
        shapes = [grid.face_shape(axis) for axis in range(3)]
        return [
            grid.trim(array.to_numpy(), shape).astype(np.float64)
            for array, shape in zip(self._faces, shapes, strict=True)
        ]


def draw(results: Sequence[CaseResult]) -> Figure:
    """Divergence left by each iteration, and refinement against an exact projection."""
    figure, (left, order) = make_panels(2, width=4.2)
    series, finest = results[0].series, max(results[0].settings["rough_cells"])
    histories = [name for name in series if name.startswith("left, ") and name.endswith(f", {finest}")]
    for name, shade in zip(histories, SHADES, strict=False):
        left.semilogy(series[name], "o-", markersize=4, color=shade, label=name.split(", ")[1])
    left.axhline(TOLERANCE, color=THEORY, linewidth=1.0, linestyle="--")
    label_axes(left, "iteration", "max|div u| h / max|u|", f"jet with noise, {finest}³ cells; dashed: goal")
    spacings = [1.0 / count for count in series["cells"]]
    curves = [
        (spacings, series[f"errors, {name}"], {"color": shade, "label": name})
        for name, shade in zip(BOUNDS, SHADES, strict=False)
    ]
    draw_refinement(order, curves, 2, "cell / box", "rms error / rms", title="exact projection")
    return figure


# Most of the time of a small grid is that of compiling its kernels: the quick case has fewer of them.
SIZES = {
    "rough_cells": ((32, 64), (32,)),  # across the unit box with the rough flow
    "exact_cells": ((16, 32, 64), (16, 32)),  # across the one that has an exact projection
    "bodies": ((False, True), (True,)),  # whether a ball is in the rough flow
}
CASE = Case(find, draw, solvers=("smoke",), sizes=SIZES)
