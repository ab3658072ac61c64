"""A spinning, stirred drop without gravity or walls keeps its linear and angular momentum."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.validation.checks import CaseResult, Check
from benchmarks.validation.fluids import EVERY_FACE, FLUID_SOLVERS, WEIGHTLESS, advance, lattice, make_fluid, state_of
from sim.domain import DomainParameters

SOLVERS = FLUID_SOLVERS
SPACING, HALF_SIDE = 0.02, 0.1
SPIN, STIRRING = 4.0, 0.3
"""Angular velocity [rad/s] and the standard deviation of what is added to each component [m/s]."""

DURATION, QUICK_DURATION = 0.4, 0.1
"""How long the drop is followed [s]: until it has spun by 90 degrees and its stirring has died."""


def run(solver: str, *, quick: bool = False) -> CaseResult:
    """A cube of fluid with viscosity and cohesion that spins, is stirred and falls apart."""
    duration = QUICK_DURATION if quick else DURATION
    domain = DomainParameters(min=(-2.0,) * 3, max=(2.0,) * 3, open_faces=EVERY_FACE)
    particles = lattice((-HALF_SIDE,) * 3, (HALF_SIDE,) * 3, SPACING)
    velocity = np.cross([0.0, 0.0, SPIN], particles)
    velocity += np.random.default_rng(5).normal(0.0, STIRRING, particles.shape)
    fluid = make_fluid(
        solver,
        domain,
        particles,
        spacing=SPACING,
        velocities=velocity,
        gravity=WEIGHTLESS,
        viscosity=1e-3,
        surface_tension=1e-4,
    )
    mass = fluid.diagnostics()["mass"] / len(particles)
    start = _totals(fluid, mass)
    speed = float(np.sqrt((velocity**2).sum(axis=1).mean()))
    arm = float(np.sqrt((particles.astype(float) ** 2).sum(axis=1).mean()))
    scales = (mass * len(particles) * speed, mass * len(particles) * speed * arm)
    drifts: dict[str, list[float]] = {"times": [], "linear": [], "angular": []}
    for time in advance(fluid, duration, cuts=50):
        linear, angular = (
            float(np.abs(now - before).max()) / scale
            for now, before, scale in zip(_totals(fluid, mass), start, scales, strict=True)
        )
        for name, value in zip(drifts, (time, linear, angular), strict=True):
            drifts[name].append(value)
    checks = [
        Check("drift of linear momentum over m v_rms", max(drifts["linear"]), 0.0, 1e-5,
              "the required bound; pair forces cancel but for float32 rounding (6e-8 a kick)"),
        Check("drift of angular momentum over m v_rms r_rms", max(drifts["angular"]), 0.0, 1e-5,
              "the required bound; all pair forces are central"),
        Check("particles lost", float(len(particles) - fluid.particle_count), 0.0, 0.0, "a count"),
    ]  # fmt: skip
    settings = {
        "particles": len(particles),
        "duration_s": duration,
        "spin_rad_per_s": SPIN,
        "stirring_m_per_s": STIRRING,
    }
    return CaseResult("free-momentum", solver, settings, checks, drifts)


def _totals(fluid: Any, mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear [kg m/s] and angular momentum about the origin [kg m²/s]."""
    position, velocity = state_of(fluid)
    return mass * velocity.sum(axis=0), mass * np.cross(position, velocity).sum(axis=0)
