"""Air that turns: a blob in solid rotation, Taylor and Green's vortices, and a lone one that confinement spins up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from validation.cases import Case, Found
from validation.checks import TITLES, CaseResult, Check, fitted_order, order_of_differences
from validation.figures import COLOURS, draw_refinement, label_axes, make_panels, plot_each, style_of
from validation.smoke_boxes import (
    Advection,
    Array,
    build_box,
    faces_of,
    kinetic_energy,
    rms_error,
    set_flow,
    take_steps,
)

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

STEPS_PER_CELL = 2  # steps in which the fastest air crosses a cell: time and space are refined together
PLANE_DURATION, TIMED_DURATION, SPACE_DURATION = 1.0, 0.5, 1.0  # in the plane, to tell the orders apart, in space [s]
LONE_CELLS, LONE_LAYERS, CORE = 32, 12, 0.1  # across and along its box of 1 m; radius of the core [m]
BLOB_OFFSET, BLOB_RADIUS = 0.15, 0.02**0.5  # from the middle, and where it has fallen to 1/e [m]
SPAN, SHOWN = 0.01, 0.5  # how long it is spun up to measure the rate, a radian of its core, and for the figure [s]


EXPECTED = {
    "maccormack": (
        "MacCormack",
        (2.5, 0.5, "third but for the crest that the limiter cuts, and second across axes"),
        (2.0, 0.25, "extrapolated from two steps at each grid"),
    ),
    "semi_lagrangian": (
        "donor cells and linear look-ups",
        (0.75, 0.35, "first, where the blob is wide against what it is smeared by"),
        (1.0, 0.25, "likewise; their diffusion is |u| h a second, and stays"),
    ),
}
"""Name of the advection; orders of a blob in rotation, where a linear look-up has diffusion of first order and shows
less than that on coarse grids; and of what is left of the error when the one in time is extrapolated away."""


def find(
    solver: Advection,
    *,
    plane_cells: Sequence[int],
    space_cells: Sequence[int],
    modes: int,
    force_cells: Sequence[int],
    strengths: Sequence[float],
) -> Found:
    """Rest, rotation, vortices in the plane and in space, orders in time, and a lone vortex with confinement."""
    boxes = {n: build_box((n, n, 4), 1.0 / n, advection=solver) for n in plane_cells}
    plane = [_in_the_plane(box) for box in boxes.values()]
    space = _vortex_in_space(space_cells, solver, modes=modes)
    # Confinement pushes the same, however air is advected.
    spun = _spin_up(solver, strengths) if strengths and solver == "maccormack" else {}
    force_cells = force_cells if solver == "maccormack" else ()
    spacings = [1.0 / n for n in plane_cells]
    changes, rotation_errors, plane_errors, plane_losses = (list(column) for column in zip(*plane, strict=True))
    space_errors, space_losses = (list(column) for column in zip(*space, strict=True))
    timed = _in_time([boxes[n] for n in plane_cells])
    named, blob, left = EXPECTED[solver]
    checks = [
        Check("largest change of any field in air at rest", max(changes), 0.0, 0.0, "to the bit"),
        Check(f"order of a blob in solid rotation, {named}", fitted_order(spacings, rotation_errors), *blob),
        Check("order of the velocity in a plane vortex", fitted_order(spacings, plane_errors), 1.0, 0.25,
              "advection by the velocity of the step's start, pressure after it: a splitting of first order in time"),
        Check("order of the energy that it loses", fitted_order(spacings, plane_losses), 1.0, 0.25, "likewise"),
        Check("order of the velocity in a vortex in space", fitted_order([1.0 / n for n in space_cells], space_errors),
              1.0, 0.25, "likewise; against a spectral solution"),
        Check("order in time alone: a plane vortex in ever shorter steps", timed["order"], 1.0, 0.15,
              "the grid stays; differences of solutions whose steps are halved"),
        Check(f"order of what is left for infinitely short steps, {named}", timed["order_left"], *left),
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
    series: dict[str, Any] = {"plane_cells": list(plane_cells), "rotation_errors": rotation_errors}
    series |= {"plane_errors": plane_errors, "plane_losses": plane_losses}
    series |= {"space_cells": list(space_cells), "space_errors": space_errors, "space_losses": space_losses}
    series |= {f"energy_{strength:g}": found["energies"] for strength, found in spun.items()}
    if spun:
        series["times"] = spun[0.0]["times"]
    return checks, series


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
            take_steps(solver, TIMED_DURATION, first * refinement)
            found.append(np.concatenate([face.ravel() for face in faces_of(solver)]))
        grid = solver.grid
        exact = np.concatenate([plane_vortex(grid.face_centres(axis))[:, axis] for axis in range(3)])
        lefts.append(float(np.sqrt(((2.0 * found[1] - found[0] - exact) ** 2).mean())))
        if solver is boxes[0]:
            order = order_of_differences(*found)
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
    take_steps(solver, 0.3, 3)
    after = solver.checkpoint()
    return max(float(np.abs(after[name] - array).max()) for name, array in before.items() if name != "clock")


def _in_the_plane(solver: SmokeSolver) -> tuple[float, float, float, float]:
    """Errors in a unit square with n cells across.

    Returns:
        Largest change of air at rest; mean error of a smooth blob after one turn in 4 n steps of advection alone, over
        its mean; error of the velocity of Taylor and Green's vortex over its rms; part of the kinetic energy that this
        loses.
    """
    grid, fields = solver.grid, solver.state.velocity
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
        solver._transport.advance(0.25)
    density = grid.trim(solver.checkpoint()["density"], grid.cells).ravel()
    blob_error = float(np.abs(density - blob).sum() / blob.sum())

    set_flow(solver, plane_vortex)
    before, scale = kinetic_energy(solver), rms_error(solver, np.zeros_like)
    take_steps(solver, PLANE_DURATION, round(STEPS_PER_CELL * n * PLANE_DURATION))
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
        take_steps(solver, SPACE_DURATION, math.ceil(STEPS_PER_CELL * n * SPACE_DURATION / math.pi))
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
    solver._accelerate(1.0)
    gained = [after - old for after, old in zip(faces_of(solver), before, strict=True)]
    torque = 0.0
    for axis, sign in ((0, -1.0), (1, 1.0)):
        arms = (solver.grid.face_centres(axis)[:, 1 - axis] - 0.5).reshape(solver.grid.face_shape(axis))
        torque += sign * float((arms * gained[axis])[:, :, 4].sum()) / n**2  # near the lids none acts
    return torque / (math.pi**1.5 * CORE / n)


def _spin_up(advection: Advection, strengths: Sequence[float]) -> dict[float, dict[str, Any]]:
    """By confinement: its power over what the formula says, and the energy over that of the start, over time."""
    n, middle = LONE_CELLS, slice(LONE_LAYERS // 2 - 1, LONE_LAYERS // 2 + 1)  # near the lids no confinement acts
    found: dict[float, dict[str, Any]] = {}
    for strength in (0.0, *strengths):
        solver = build_box((n, n, LONE_LAYERS), 1.0 / n, advection=advection, vorticity_confinement=strength)
        set_flow(solver, lone_vortex)
        take_steps(solver, SPAN, 4)
        energies = [kinetic_energy(solver, layers=middle)]
        for _ in range(round(SHOWN / SPAN / 4)):
            take_steps(solver, 4 * SPAN, 4)
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
        return force - self._k * (self._k * force).sum(axis=0) / self._k_squared

    def velocity(self, positions: Array) -> Array:
        """The series at positions that form a lattice, (n, 3), in C order."""
        axes = [np.unique(positions[:, axis].round(12)) for axis in range(3)]
        frequency = np.fft.fftfreq(self._n, 1.0 / self._n)
        half = np.arange(self._n // 2 + 1)
        # The other half of the last axis is the conjugate one: twice the real part, but for its ends.
        weights = np.where((half == 0) | (half == self._n // 2), 1.0, 2.0)
        waves = [np.exp(1j * np.outer(x, k)) for x, k in zip(axes, (frequency, frequency, half), strict=True)]
        values = np.einsum("xa,yb,zc,dabc->xyzd", *waves[:2], waves[2] * weights, self.coefficients, optimize=True)
        return values.real.reshape(-1, 3) / self._n**3


def draw(results: Sequence[CaseResult]) -> Figure:
    """Refinement of a turning blob and of vortices, energy of a lone vortex with confinement."""
    figure, (blob, vortices, energy) = make_panels(3)
    turned, solid, dashed = [], [], []
    for result in results:
        series, style = result.series, style_of(result)
        plane, space = ([1.0 / count for count in series[f"{name}_cells"]] for name in ("plane", "space"))
        turned.append((plane, series["rotation_errors"], style))
        solid.append((plane, series["plane_errors"], style))
        unnamed = {"color": COLOURS[result.solver], "linestyle": "--", "marker": "s"}
        dashed.append((space, series["space_errors"], unnamed))
    draw_refinement(blob, turned, 2, "cell / box", "mean error / mean", title="blob, one turn")
    title = "vortices: plane (solid), in space (dashed)"
    draw_refinement(vortices, [*solid, *dashed], 1, "cell / box", "rms error / rms", title=title)
    shown = results[0]
    strengths = {f"energy_{each:g}": f"eps = {each:g}" for each in (0.0, *shown.settings["strengths"])}
    plot_each(energy, shown.series, "times", strengths)
    label_axes(energy, "time [s]", "kinetic energy / at first", f"lone vortex, {TITLES[shown.solver]}")
    return figure


# Each box costs the compilation of its kernels: the quick case has none for the steps of the lone vortex, and of the
# boxes for the force the finer one, which allows it the smaller deviation.
SIZES = {
    "plane_cells": ((32, 64, 128), (32, 64)),  # across the unit square with a blob that goes round, or a plane vortex
    "space_cells": ((16, 32, 64), (16, 32)),  # across the box of pi metres with the vortex in space
    "modes": (48, 32),  # of the spectral solution that this is compared with
    "force_cells": ((32, 64), (64,)),  # across the box where confinement's force is compared with its formula
    "strengths": ((0.5, 1.0), ()),  # of the confinements with which the lone vortex is spun up
}
CASE = Case(find, draw, solvers=("maccormack", "semi_lagrangian"), sizes=SIZES)
