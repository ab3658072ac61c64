"""A sphere in water at rest: what it weighs less while it is held, and how it starts when it is let go."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sim.fluid.wcsph import WCSPHSolver
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import COLOURS, THEORY, label_axes, make_panels, style_of
from validation.scenes import GRAVITY, SPACING, WATER, Curve, advance, steps, submerged_sphere

DENSITIES = (500.0, 2000.0)  # of the sphere that is let go [kg/m³]
SETTLING, INTERVAL = 0.6, 0.1  # the sphere is held until the water rests; between two releases [s]

SOLVE_TOLERANCE = 1.0e-5
"""Compression that implicit solves may leave here, a tenth of the default one: what is measured is to be the method.
At the default one, push and added mass at five spacings have standard errors of 0.01 and 0.03 after 16 releases."""

FOLLOWED = 0.03  # how long it is followed [s]: it goes a tenth of a spacing, and sound crosses the tank twice at least
POINTS = 30  # points in time at which the motions of all releases are averaged

ADDED_MASS = 0.531
"""Added over displaced mass of a sphere that is let go in the middle of this tank.

Half in water without end (Lamb 1932, §92), and 3/8 (R/L)³ of that more at a wall across the motion at distance L, 3/16
at one along it, as the mirrored dipole adds; here the sum over all mirror images in floor, sides and free surface.
"""

LARGEST_SHIFT, LARGEST_MASS_ERROR = 0.05, 0.1  # of the radius of what is displaced [spacings]; of the mass ratio


class Experiment(NamedTuple):
    """A sphere of one size with one solver, held, and let go at many moments."""

    times: Curve  # points in time after a release [s], (p,)
    held: Curve  # impulse of the water on the held sphere over rho_f V [m/s], of each moment on, (releases, p)
    speeds: dict[float, Curve]  # upward velocity of the released sphere [m/s], by density, (releases, p) each
    forces: Curve  # mean vertical force on the held sphere between two moments over rho_f g V, (releases,)
    sideways: float  # size of the mean horizontal force on it, likewise
    sound_delay: float  # time until the water around the sphere has answered [s]
    astray: int  # particles in the sphere or out of the tank at the end


class Answer(NamedTuple):
    """Coefficients of the equation of motion, or their standard errors."""

    push: float  # force of the water on the sphere before it moves, over that on the held one
    added_mass: float  # over the displaced mass
    stiffness: float  # of the water at rest over the displaced mass [1/s²]


def find(solver: str, sizes: Sequence[int], releases: int) -> Found:
    """Spheres of all sizes, their radii in spacings, held, and let go at so many moments, once with each density."""
    checks: list[Check] = []
    series: dict[str, Any] = {"sizes": list(sizes)}
    forces, added = [], []
    for size in sizes:
        experiment = release_often(solver, size * SPACING, releases)
        answer, errors = equation_of_motion(experiment)
        force, force_error = float(experiment.forces.mean()), _standard_error(experiment.forces)
        forces.append((force, force_error))
        added.append((answer.added_mass, errors.added_mass))
        checks += _checks(size, experiment, answer)
        series |= _series(experiment)  # Of the largest one in the end.
    for name, pairs in (("held", forces), ("added_mass", added)):
        series |= {name: [value for value, _ in pairs], f"{name}_error": [error for _, error in pairs]}
    return checks, series


def release_often(solver: str, radius: float, moments: int) -> Experiment:
    """Hold a sphere in water, and let a copy of it go at many moments.

    The force on a held sphere sways by a tenth, with the sloshing and the sound of so small a tank and the slips of its
    particles, so that a single release says little. Steps are as long after a release as before: implicit solvers take
    the density error that their tolerance left within a longer step back in a shorter one, and kick the sphere.
    """
    material = {} if solver == "wcsph" else {"density_tolerance": SOLVE_TOLERANCE}
    held = submerged_sphere(solver, None, radius, **material)
    free = {density: submerged_sphere(solver, density, radius, **material) for density in DENSITIES}
    starts = {density: tank.rigid.checkpoint() for density, tank in free.items()}
    mass = WATER * 4.0 / 3.0 * np.pi * radius**3
    times = np.linspace(0.0, FOLLOWED, POINTS + 1)
    for _ in advance(held, SETTLING):
        pass
    pushes, forces = [], []
    speeds: dict[float, list[Curve]] = {density: [] for density in DENSITIES}
    for _ in range(moments):
        state, dt = held.fluid.checkpoint(), held.stable_dt()
        count = int(np.ceil(FOLLOWED / dt * (1.0 - 1.0e-9)))
        at = dt * np.arange(count + 1)
        impulse = np.zeros((1, 3))
        impulses = [impulse := impulse]
        for _ in range(count):
            held.substep(dt)
            impulses.append(impulse := impulse + dt * held.coupling.force)
        for density, tank in free.items():
            # The water of the other tank around the sphere, which is at rest where it began.
            tank.rigid.restore(starts[density])
            tank.fluid.restore(state)
            tank.coupling.resume()
            motion = [0.0]
            for _ in range(count):
                tank.substep(dt)
                motion.append(float(tank.rigid.bodies.velocity[0, 2]))
            speeds[density].append(np.interp(times, at, motion))
        pushes.append(np.interp(times, at, np.array(impulses)[:, 0, 2] / mass))
        for step in steps(held, INTERVAL - count * dt):
            impulse = impulse + step * held.coupling.force
        forces.append(impulse[0] / (INTERVAL * mass * GRAVITY))
    mean = np.mean(forces, axis=0)
    # Sound that is sent out by a sphere that starts dies down to a tenth in this time.
    sound_delay = 2.0 * radius / held.fluid.sound_speed if isinstance(held.fluid, WCSPHSolver) else 0.0
    return Experiment(
        times=times,
        held=np.array(pushes),
        speeds={density: np.array(each) for density, each in speeds.items()},
        forces=np.array(forces)[:, 2],
        sideways=float(np.linalg.norm(mean[:2])),
        sound_delay=sound_delay,
        astray=held.astray(),
    )


def equation_of_motion(experiment: Experiment) -> tuple[Answer, Answer]:
    """Coefficients of rho_s (v + g t) = push J(t) - added mass rho_f v - stiffness rho_f (integral of the way).

    J is what the held sphere got from the same moment on, so that what the water does anyway cancels. Fitted to the
    mean motions of both densities together, as the water is the same for both. Also returns the standard errors, by
    leaving out one release after the other (jackknife).
    """
    count = len(experiment.held)
    everything = np.arange(count)
    left_out = np.array([_fit(experiment, everything[everything != number]) for number in everything])
    errors = np.sqrt((count - 1) / count * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))
    return Answer(*_fit(experiment, everything).tolist()), Answer(*errors.tolist())


def _fit(experiment: Experiment, chosen: NDArray[np.integer]) -> Curve:
    times = experiment.times
    first = int(np.searchsorted(times, experiment.sound_delay))
    held = experiment.held[chosen].mean(axis=0)
    rows, sides = [], []
    for density in DENSITIES:
        speed = experiment.speeds[density][chosen].mean(axis=0)
        terms = np.stack([held, -speed, -_integral(_integral(speed, times), times)], axis=1)
        side = density / WATER * (speed + GRAVITY * times)
        rows.append(terms[first + 1 :] - terms[first])
        sides.append(side[first + 1 :] - side[first])
    return np.linalg.lstsq(np.concatenate(rows), np.concatenate(sides), rcond=None)[0]


def _checks(size: int, experiment: Experiment, answer: Answer) -> list[Check]:
    force, at = float(experiment.forces.mean()), f"R = {size} d"
    volume_error, mass_error = LARGEST_SHIFT * 3.0 / size, LARGEST_MASS_ERROR
    checks = [
        Check(f"force on a held sphere over rho g V, {at}", force, 1.0, volume_error,
              "a twentieth of a spacing in the radius of what it displaces"),
        Check(f"sideways force on it over rho g V, {at}", experiment.sideways, 0.0, 0.03,
              "symmetry; its mean has a standard error of about a hundredth"),
        Check(f"push on it when it is let go over that on the held one, {at}", answer.push, 1.0, 0.02,
              "the same water; what the solves leave, and the fit"),
        Check(f"added over displaced mass, {at}", answer.added_mass, ADDED_MASS, mass_error,
              "the mirror images' sum; radius as above, and what the fit takes for it of sound and friction"),
    ]  # fmt: skip
    for density in DENSITIES:
        mass = density + ADDED_MASS * WATER
        ratio = (force * answer.push * WATER - density) / (WATER - density)
        ratio *= mass / (density + answer.added_mass * WATER)
        tolerance = WATER / abs(WATER - density) * volume_error + WATER / mass * mass_error
        reason = "the tolerances of force and added mass, as they count in it"
        checks.append(
            Check(f"first acceleration at {density:g} kg/m³ over theory, {at}", ratio, 1.0, tolerance, reason)
        )
    astray = float(experiment.astray)
    return [*checks, Check(f"particles in the sphere or out of the tank, {at}", astray, 0.0, 0.0, "a count")]


def _series(experiment: Experiment) -> dict[str, Any]:
    """Mean speeds after a release over what the theory says of the first acceleration [s]."""
    series: dict[str, Any] = {"times": experiment.times}
    for density in DENSITIES:
        theory = GRAVITY * (WATER - density) / (density + ADDED_MASS * WATER)
        series[f"released_{density:g}"] = experiment.speeds[density].mean(axis=0) / theory
    return series


def _integral(values: Curve, times: Curve) -> Curve:
    """By the trapezoidal rule, from the first time on."""
    parts = 0.5 * (values[1:] + values[:-1]) * np.diff(times)
    return np.concatenate([[0.0], np.cumsum(parts)])


def _standard_error(values: Curve) -> float:
    return float(np.std(values, ddof=1) / np.sqrt(len(values)))


def draw(results: Sequence[CaseResult]) -> Figure:
    """Force on held spheres and added mass by size, speed of released ones."""
    figure, (held, added, released) = make_panels(3)
    dashes = dict(zip(DENSITIES, ("-", "--"), strict=True))
    for number, result in enumerate(results):
        series, style = result.series, {**style_of(result), "markersize": 4, "linewidth": 1.0}
        sizes = [size + 0.06 * (number - 1) for size in series["sizes"]]
        for axes, name in ((held, "held"), (added, "added_mass")):
            axes.errorbar(sizes, series[name], series[f"{name}_error"], fmt="o-", **style)
        times = [1e3 * time for time in series["times"]]
        for density, dash in dashes.items():
            released.plot(times, series[f"released_{density:g}"], dash, color=COLOURS[result.solver])
    panels = (
        (held, 1.0, (0.9, 1.1), "force / rho g V", "held sphere; bars: standard error"),
        (added, ADDED_MASS, (0.4, 0.7), "added / displaced mass", "sphere let go; black: theory"),
    )
    for axes, theory, limits, y, title in panels:
        axes.set_xticks(series["sizes"])
        axes.axhline(theory, color=THEORY, linewidth=1.0)
        axes.set_ylim(*limits)
        label_axes(axes, "radius / spacing", y, title)
    released.plot([0.0, times[-1]], [0.0, 1e-3 * times[-1]], color=THEORY, linewidth=1.0, label="theory at first")
    for density, dash in dashes.items():
        released.plot([], [], dash, color="#777777", label=f"{density:g} kg/m³")
    label_axes(released, "time [ms]", "speed / first acceleration [s]", f"R = {series['sizes'][-1]} d")
    return figure


CASE = Case(find, draw, sizes={"sizes": ((3, 4, 5), (3,)), "releases": (8, 2)})
