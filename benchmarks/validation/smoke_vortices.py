"""Air that turns: a blob in solid rotation, Taylor and Green's vortices, and a lone one that confinement spins up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.validation.checks import CaseResult, Check, fitted_order
from benchmarks.validation.smoke_boxes import (
    FACES,
    Advection,
    Array,
    advance,
    build_box,
    faces_of,
    kinetic_energy,
    rms_error,
    set_flow,
)

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

SOLVERS = ("maccormack", "semi_lagrangian")

STEPS_PER_CELL = 2
"""Steps in which the fastest air crosses a cell: time and space are refined together."""

PLANE_CELLS, PLANE_DURATION = (32, 64, 128), 1.0
"""Across the unit square with a blob that goes round once, or a plane vortex, and how long that turns [s]."""

TIMED_DURATION = 0.5
"""How long a plane vortex turns by which orders in time and in space are told apart [s]."""

SPACE_CELLS, SPACE_DURATION = (16, 32, 64), 1.0
"""Across the box of pi metres with the one in space, and how long it is compared [s]."""

LONE_CELLS, LONE_LAYERS, CORE = 32, 12, 0.1
"""Across and along the box of 1 m with the lone vortex, and the radius of its core [m]."""

STRENGTHS = (0.5, 1.0)
"""Confinements with which the lone vortex is spun up."""

FORCE_CELLS = (32, 64)
"""Across the box where confinement's force on it is compared with its formula."""

BLOB_OFFSET, BLOB_RADIUS = 0.15, 0.02**0.5
"""Of the blob that goes round: from the middle [m], and where it has fallen to 1/e [m]: 4.5 cells at least."""

SPAN, SHOWN = 0.01, 0.5
"""How long it is spun up to measure the rate, a radian of its core, and for the figure [s]."""


def run(solver: Advection, *, quick: bool = False) -> CaseResult:
    """Rest, rotation, vortices in the plane and in space, orders in time, and a lone vortex with confinement."""
    plane_cells, space_cells = (PLANE_CELLS[:2], SPACE_CELLS[:2]) if quick else (PLANE_CELLS, SPACE_CELLS)
    boxes = {n: build_box((n, n, 4), 1.0 / n, advection=solver) for n in plane_cells}
    plane = [_in_the_plane(box) for box in boxes.values()]
    space = _vortex_in_space(space_cells, solver, modes=32 if quick else 48)
    # Each box costs the compilation of its kernels: the quick case has none for the steps of the lone vortex.
    spun = {} if quick or solver != "maccormack" else _spin_up(solver)
    # Confinement pushes the same, however air is advected; the finer box allows it the smaller deviation.
    force_cells = (FORCE_CELLS[-1:] if quick else FORCE_CELLS) if solver == "maccormack" else ()
    spacings = [1.0 / n for n in plane_cells]
    changes, rotation_errors, plane_errors, plane_losses = (list(column) for column in zip(*plane, strict=True))
    space_errors, space_losses = (list(column) for column in zip(*space, strict=True))
    timed = _in_time([boxes[n] for n in plane_cells])
    checks = [
        Check("largest change of any field in air at rest", max(changes), 0.0, 0.0, "to the bit"),
        *_order_checks(solver, spacings, rotation_errors, plane_errors, plane_losses),
        Check("order of the velocity in a vortex in space", fitted_order([1.0 / n for n in space_cells], space_errors),
              1.0, 0.25, "likewise; against a spectral solution"),
        Check("order in time alone: a plane vortex in ever shorter steps", timed["order"], 1.0, 0.15,
              "the grid stays; differences of solutions whose steps are halved"),
        _left_check(solver, timed["order_left"]),
        *[
            Check(f"torque of confinement over that of its formula, {n} cells", _confinement_torque(n), 1.0,
                  0.5 * (1.0 / n / CORE) ** 2, "central differences flatten the core: half of (h/a)² at most")
            for n in force_cells
        ],
        *[
            Check(f"power of confinement {strength:g} over that of the formula", spun[strength]["gain"], 1.0, 0.12,
                  "linear in epsilon and h; central differences flatten a core of 3.2 cells by about (h/a)²")
            for strength in spun
            if strength > 0.0
        ],
    ]  # fmt: skip
    series = {
        "plane_cells": list(plane_cells), "rotation_errors": rotation_errors, "plane_errors": plane_errors,
        "plane_losses": plane_losses, "space_cells": list(space_cells), "space_errors": space_errors,
        "space_losses": space_losses,
        **{f"energy_{strength:g}": found["energies"] for strength, found in spun.items()},
    }  # fmt: skip
    if spun:
        series["times"] = spun[0.0]["times"]
    settings = {
        "steps_per_cell": STEPS_PER_CELL, "plane_duration_s": PLANE_DURATION, "space_duration_s": SPACE_DURATION,
        "core_m": CORE, "strengths": STRENGTHS, "projection_tolerance": 1e-5,
    }  # fmt: skip
    return CaseResult("smoke-vortices", solver, settings, checks, series)


def _order_checks(
    solver: Advection, spacings: list[float], rotation: list[float], plane: list[float], losses: list[float]
) -> list[Check]:
    """Orders in the plane; a linear look-up has diffusion of first order, and shows less than that on coarse grids."""
    splitting = "advection by the velocity of the step's start, pressure after it: a splitting of first order in time"
    if solver == "maccormack":
        blob = Check("order of a blob in solid rotation, MacCormack", fitted_order(spacings, rotation), 2.0, 0.5,
                     "second, but for the crest that the limiter cuts")  # fmt: skip
    else:
        blob = Check("order of a blob in solid rotation, linear look-ups", fitted_order(spacings, rotation), 0.75, 0.35,
                     "first, where the blob is wide against what it is smeared by")  # fmt: skip
    return [
        blob,
        Check("order of the velocity in a plane vortex", fitted_order(spacings, plane), 1.0, 0.25, splitting),
        Check("order of the energy that it loses", fitted_order(spacings, losses), 1.0, 0.25, "likewise"),
    ]


def _left_check(solver: Advection, order: float) -> Check:
    """Order of what is left of the error when the one in time is extrapolated away."""
    name = "order of what is left for infinitely short steps"
    if solver == "maccormack":
        return Check(f"{name}, MacCormack", order, 2.0, 0.25, "extrapolated from two steps at each grid")
    return Check(f"{name}, linear look-ups", order, 1.0, 0.25, "likewise; their diffusion is |u| h a second, and stays")


def _in_time(boxes: Sequence[SmokeSolver]) -> dict[str, float]:
    """Orders of a plane vortex in time alone, on the coarsest grid, and of what is left without the error in time.

    That is left by 2 u(dt/2) - u(dt), which cancels an error of first order in time, against the exact flow.
    """
    lefts, order = [], 0.0
    for solver in boxes:
        first = round(solver.grid.cells[0] * TIMED_DURATION)
        found = []
        for refinement in (1, 2, 4) if solver is boxes[0] else (1, 2):
            set_flow(solver, plane_vortex)
            advance(solver, TIMED_DURATION, first * refinement)
            found.append(np.concatenate([face.ravel() for face in faces_of(solver)]))
        grid = solver.grid
        exact = np.concatenate([plane_vortex(grid.face_centres(axis))[:, axis] for axis in range(3)])
        lefts.append(float(np.sqrt(((2.0 * found[1] - found[0] - exact) ** 2).mean())))
        if solver is boxes[0]:
            order = math.log2(np.linalg.norm(found[1] - found[0]) / np.linalg.norm(found[2] - found[1]))
    return {"order": order, "order_left": fitted_order([box.grid.cell_size for box in boxes], lefts)}


def plane_vortex(positions: Array) -> Array:
    """Taylor and Green's plane vortex in the unit square, at rest across its walls: steady without viscosity."""
    x, y = math.pi * positions[:, 0], math.pi * positions[:, 1]
    return np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), np.zeros_like(x)], axis=1)


def vortex_in_space(positions: Array) -> Array:
    """Taylor and Green's vortex in an eighth of its period, whose walls no flow crosses."""
    x, y, z = positions.T
    return np.stack([np.sin(x) * np.cos(y) * np.cos(z), -np.cos(x) * np.sin(y) * np.cos(z), np.zeros_like(x)], axis=1)


def lone_vortex(positions: Array) -> Array:
    """Lamb and Oseen's, of circulation 2 pi m²/s, in the middle of the unit square: omega = 2/a² exp(-r²/a²)."""
    x, y = positions[:, 0] - 0.5, positions[:, 1] - 0.5
    r_squared = np.maximum(x**2 + y**2, 1e-12)
    swirl = -np.expm1(-r_squared / CORE**2) / r_squared
    return np.stack([-y * swirl, x * swirl, np.zeros_like(x)], axis=1)


def rotation(positions: Array) -> Array:
    """Solid rotation about the middle of the unit square, once a second."""
    x, y = positions[:, 0] - 0.5, positions[:, 1] - 0.5
    return 2.0 * math.pi * np.stack([-y, x, np.zeros_like(x)], axis=1)


def _change_at_rest(solver: SmokeSolver) -> float:
    """Largest change of any array of the state in three steps of air at rest with uneven smoke and heat in it."""
    random = np.random.default_rng(1)
    density, excess = random.random((2, *solver.grid.cells))
    set_flow(solver, np.zeros_like, density=density, excess_temperature=100.0 * excess)
    before = solver.checkpoint()
    advance(solver, 0.3, 3)
    after = solver.checkpoint()
    return max(float(np.abs(after[name] - array).max()) for name, array in before.items() if name != "clock")


def _in_the_plane(solver: SmokeSolver) -> tuple[float, float, float, float]:
    """Errors in a unit square with n cells across.

    Returns:
        Largest change of air at rest; mean error of a smooth blob after one turn in 4 n steps of advection alone, over
        its mean; error of the velocity of Taylor and Green's vortex over its rms; part of the kinetic energy that this
        loses.
    """
    grid, fields = solver.grid, [getattr(solver, name) for name in FACES]
    n = grid.cells[0]
    x, y, _ = (grid.cell_centres() - 0.5).T
    change = _change_at_rest(solver)
    blob = np.exp(-((x - BLOB_OFFSET) ** 2 + y**2) / BLOB_RADIUS**2)
    set_flow(solver, np.zeros_like, density=blob)
    turning = [rotation(grid.face_centres(axis))[:, axis].reshape(grid.face_shape(axis)) for axis in range(3)]
    stored = [grid.pad(values.astype(np.float32)).ravel() for values in turning]
    for _ in range(4 * n):
        # The velocity would advect itself; the flow is to stay the same, and goes through the walls.
        for field, values in zip(fields, stored, strict=True):
            field.from_numpy(values)
        solver._advection.advance(0.25 / n)
    density = grid.trim(solver.checkpoint()["density"], grid.cells).ravel()
    blob_error = float(np.abs(density - blob).sum() / blob.sum())

    set_flow(solver, plane_vortex)
    before, scale = kinetic_energy(solver), rms_error(solver, np.zeros_like)
    advance(solver, PLANE_DURATION, round(STEPS_PER_CELL * n * PLANE_DURATION))
    return change, blob_error, rms_error(solver, plane_vortex) / scale, 1.0 - kinetic_energy(solver) / before


def _vortex_in_space(counts: tuple[int, ...], advection: Advection, *, modes: int) -> list[tuple[float, float]]:
    """Error of the velocity over its rms against a spectral solution, and part of the kinetic energy that is lost."""
    exact = SpectralEuler(modes)
    exact.advance(SPACE_DURATION, 40)
    found = []
    for n in counts:
        solver = build_box((n, n, n), math.pi / n, advection=advection)
        set_flow(solver, vortex_in_space)
        before, scale = kinetic_energy(solver), rms_error(solver, np.zeros_like)
        advance(solver, SPACE_DURATION, math.ceil(STEPS_PER_CELL * n * SPACE_DURATION / math.pi))
        found.append((rms_error(solver, exact.velocity) / scale, 1.0 - kinetic_energy(solver) / before))
    return found


def _confinement_torque(n: int) -> float:
    """Torque of confinement's force about the middle of the lone vortex, n cells across, over that of the formula.

    omega = 2/a² exp(-r²/a²) falls outwards, so epsilon h (N x omega) pushes along the flow: a metre along the axis the
    torque is epsilon h times the integral of 2 pi r² omega, which is pi^(3/2) a.
    """
    solver = build_box((n, n, 8), 1.0 / n, vorticity_confinement=1.0)
    set_flow(solver, lone_vortex)
    before = faces_of(solver)
    solver._forces.accelerate(1.0)
    gained = [after - old for after, old in zip(faces_of(solver), before, strict=True)]
    torque = 0.0
    for axis, sign in ((0, -1.0), (1, 1.0)):
        arms = (solver.grid.face_centres(axis)[:, 1 - axis] - 0.5).reshape(solver.grid.face_shape(axis))
        torque += sign * float((arms * gained[axis])[:, :, 4].sum()) / n**2  # near the lids none acts
    return torque / (math.pi**1.5 * CORE / n)


def _spin_up(advection: Advection) -> dict[float, dict[str, Any]]:
    """By confinement: its power over what the formula says, and the energy over that of the start, over time."""
    n, middle = LONE_CELLS, slice(LONE_LAYERS // 2 - 1, LONE_LAYERS // 2 + 1)  # near the lids no confinement acts
    found: dict[float, dict[str, Any]] = {}
    for strength in (0.0, *STRENGTHS):
        solver = build_box((n, n, LONE_LAYERS), 1.0 / n, advection=advection, vorticity_confinement=strength)
        set_flow(solver, lone_vortex)
        advance(solver, SPAN, 4)
        energies = [kinetic_energy(solver, layers=middle)]
        for _ in range(round(SHOWN / SPAN / 4)):
            advance(solver, 4 * SPAN, 4)
            energies.append(kinetic_energy(solver, layers=middle))
        times = [SPAN * (1 + 4 * number) for number in range(len(energies))]
        found[strength] = {"times": times, "energies": [energy / energies[0] for energy in energies]}
        found[strength]["first"] = energies[0]
        # epsilon h (N x omega) points along the flow where vorticity falls outwards: its power is epsilon h times the
        # integral of omega u, here over two layers.
        power = 2.0 * math.pi**1.5 / CORE * (1.0 - math.sqrt(0.5)) * strength / n * 2.0 / n
        if strength > 0.0:
            found[strength]["gain"] = (energies[0] - found[0.0]["first"]) / (power * SPAN)
    return found


class SpectralEuler:
    """Taylor and Green's vortex without viscosity, by Fourier series in a cube of 2 pi metres (Brachet et al. 1983).

    Rotational form, 2/3 rule, Runge and Kutta's fourth order: far more exact than the grids that are compared with it,
    as long as the vortex has no structures finer than its shortest wave.
    """

    def __init__(self, modes: int) -> None:
        self._n = modes
        frequency = np.fft.fftfreq(modes, 1.0 / modes)
        waves = np.meshgrid(frequency, frequency, frequency[: modes // 2 + 1], indexing="ij")
        self._k = np.abs(np.stack(waves)) * np.sign(np.stack(waves))
        self._k[2] = np.abs(self._k[2])
        self._k_squared = np.maximum((self._k**2).sum(axis=0), 1.0)
        self._kept = (np.abs(self._k) < modes / 3).all(axis=0)
        x = 2.0 * math.pi * np.arange(modes) / modes
        positions = np.stack(np.meshgrid(x, x, x, indexing="ij"), axis=-1).reshape(-1, 3)
        start = vortex_in_space(positions).T.reshape(3, modes, modes, modes)
        self.coefficients = np.fft.rfftn(start, axes=(1, 2, 3))

    def advance(self, duration: float, steps: int) -> None:
        """Advance by a duration [s] in equal steps."""
        dt = duration / steps
        for _ in range(steps):
            now = self.coefficients
            a = self._rate(now)
            b = self._rate(now + 0.5 * dt * a)
            c = self._rate(now + 0.5 * dt * b)
            d = self._rate(now + dt * c)
            self.coefficients = now + dt / 6.0 * (a + 2.0 * b + 2.0 * c + d)

    def _rate(self, u_k: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """du/dt = u x omega, less its gradient part."""
        shape, axes = (self._n,) * 3, (1, 2, 3)
        omega_k = 1j * np.cross(self._k, u_k, axis=0)
        u, omega = np.fft.irfftn(u_k, shape, axes), np.fft.irfftn(omega_k, shape, axes)
        force = np.fft.rfftn(np.cross(u, omega, axis=0), axes=axes) * self._kept
        projected: NDArray[np.complex128] = force - self._k * (self._k * force).sum(axis=0) / self._k_squared
        return projected

    def velocity(self, positions: Array) -> Array:
        """The series at positions that form a lattice, (n, 3), in C order."""
        axes = [np.unique(positions[:, axis].round(12)) for axis in range(3)]
        frequency = np.fft.fftfreq(self._n, 1.0 / self._n)
        half = np.arange(self._n // 2 + 1)
        # The other half of the last axis is the conjugate one: twice the real part, but for its ends.
        weights = np.where((half == 0) | (half == self._n // 2), 1.0, 2.0)
        waves = [np.exp(1j * np.outer(x, k)) for x, k in zip(axes, (frequency, frequency, half), strict=True)]
        values = np.einsum("xa,yb,zc,dabc->xyzd", *waves[:2], waves[2] * weights, self.coefficients, optimize=True)
        found: Array = values.real.reshape(-1, 3) / self._n**3
        return found
