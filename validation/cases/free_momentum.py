"""A spinning, stirred drop without gravity or walls keeps its linear and angular momentum."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from sim.core.domain import DomainParameters
from validation.cases import Case, Found
from validation.checks import CaseResult, Check
from validation.figures import THEORY, label_axes, make_panels, style_of
from validation.scenes import EVERY_FACE, SPACING, WEIGHTLESS, lattice, make_fluid, momentum_drifts, momentum_of

HALF_SIDE = 0.1
SPIN, STIRRING = 4.0, 0.3  # angular velocity [rad/s]; standard deviation of what is added to each component [m/s]


def find(solver: str, duration: float) -> Found:
    """A cube of fluid with viscosity and cohesion that spins, is stirred and falls apart."""
    domain = DomainParameters(min=(-2.0,) * 3, max=(2.0,) * 3, open_faces=EVERY_FACE)
    particles = lattice((-HALF_SIDE,) * 3, (HALF_SIDE,) * 3, SPACING)
    velocity = np.cross([0.0, 0.0, SPIN], particles)
    velocity += np.random.default_rng(5).normal(0.0, STIRRING, particles.shape)
    material = {"viscosity": 1e-3, "surface_tension": 1e-4}
    fluid = make_fluid(solver, domain, particles, spacing=SPACING, velocities=velocity, gravity=WEIGHTLESS, **material)
    mass = fluid.diagnostics()["mass"] / len(particles)
    speed = float(np.sqrt((velocity**2).sum(axis=1).mean()))
    arm = float(np.sqrt((particles.astype(float) ** 2).sum(axis=1).mean()))
    scales = (mass * len(particles) * speed, mass * len(particles) * speed * arm)
    drifts = momentum_drifts(fluid, lambda: momentum_of(fluid, mass), scales, duration, cuts=50)
    checks = [
        Check("drift of linear momentum over m v_rms", max(drifts["linear"]), 0.0, 1e-5,
              "the required bound; pair forces cancel but for float32 rounding (6e-8 a kick)"),
        Check("drift of angular momentum over m v_rms r_rms", max(drifts["angular"]), 0.0, 1e-5,
              "the required bound; all pair forces are central"),
        Check("particles lost", float(len(particles) - fluid.particle_count), 0.0, 0.0, "a count"),
    ]  # fmt: skip
    return checks, drifts


def draw_drifts(results: Sequence[CaseResult], curves: Mapping[str, str]) -> Figure:
    """Drift of each momentum over time, by the name of its series."""
    figure, panels = make_panels(2)
    for axes, (name, curve) in zip(panels, curves.items(), strict=True):
        for result in results:
            # A drift of exactly zero has no place on a logarithmic axis.
            drifts = [max(drift, 1e-10) for drift in result.series[curve]]
            axes.semilogy(result.series["times"], drifts, **style_of(result))
        axes.axhline(1e-5, color=THEORY, linewidth=1.0, linestyle="--", label="bound")
        axes.set_ylim(1e-10, 1e-2)
        label_axes(axes, "time [s]", "relative drift", f"{name} momentum", legend="upper left")
    return figure


def draw(results: Sequence[CaseResult]) -> Figure:
    """Drift over time."""
    return draw_drifts(results, {"linear": "linear", "angular": "angular"})


# Until it has spun by 90 degrees and its stirring has died.
CASE = Case(find, draw, sizes={"duration": (0.4, 0.1)})
