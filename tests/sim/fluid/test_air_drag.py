"""Drag of air on particles: the law of the sphere, what is in the lee, and where the momentum goes."""

import math

import numpy as np
import pytest
from pydantic import ValidationError
from small_fluids import EVERY_FACE, lattice, make_fluid

from sim.core.domain import DomainParameters
from sim.core.drag import AIR_VISCOSITY
from sim.core.water import TENSION_OF_WATER
from sim.fluid.parameters import FluidParameters, shared_conflicts

SPACE = DomainParameters(min=(-0.2,) * 3, max=(0.2,) * 3, open_faces=EVERY_FACE)
WEIGHTLESS = (0.0, 0.0, 0.0)
AIR, WATER, GRAVITY = 1.2, 1000.0, 9.81


def drag_of_drop(speed: float, radius: float) -> float:
    """1/2 rho v² C_D A of a drop that flattens in a stream (Liu, Mather & Reitz 1993) [N]."""
    reynolds = 2.0 * radius * AIR * speed / AIR_VISCOSITY
    sphere = 0.424 if reynolds > 1000.0 else 24.0 / reynolds * (1.0 + reynolds ** (2.0 / 3.0) / 6.0)
    flat = min(AIR * speed**2 * radius / TENSION_OF_WATER / 12.0, 1.0)
    return 0.5 * AIR * speed**2 * sphere * (1.0 + 2.632 * flat) * math.pi * radius**2


@pytest.mark.parametrize("solver", ["wcsph", "dfsph", "pcisph"])
@pytest.mark.parametrize(("diameter", "measured"), [(1.0e-4, 0.25), (1.0e-3, 4.03), (3.0e-3, 8.06)])
def test_a_lone_drop_falls_at_its_terminal_velocity(taichi_cpu, solver, diameter, measured):
    radius, spacing = 0.5 * diameter, diameter * (math.pi / 6.0) ** (1.0 / 3.0)
    weight = WATER * spacing**3 * GRAVITY
    low, high = 0.0, 100.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if drag_of_drop(middle, radius) < weight else (low, middle)
    # As in a wind tunnel: air that rises a little slower than the drop falls holds it in view.
    wind, way = 0.9 * low, 2.0 * low**2 / GRAVITY
    tunnel = DomainParameters(min=(-0.01, -0.01, -way), max=(0.01, 0.01, way), open_faces=EVERY_FACE)
    at_rest = np.zeros((1, 3), dtype=np.float32)
    material = {"particle_radius": spacing / 2.0, "air_density": AIR, "wind": (0.0, 0.0, wind)}
    fluid = make_fluid(tunnel, at_rest, gravity=(0.0, 0.0, -GRAVITY), solver=solver, surface_tension=0.0, **material)
    for _ in range(400):
        fluid.substep(low / GRAVITY / 50.0)
    falling = wind - fluid.snapshots()["water"].arrays["velocity"][0, 2]
    assert falling == pytest.approx(low, rel=1e-3)  # V is d³ to 3e-5, and e^-8 of a tenth is missing
    assert low == pytest.approx(measured, rel=0.1)  # by Gunn & Kinzer 1949 [m/s]


def test_no_air_acts_within_the_fluid_and_it_gets_what_the_surface_loses(taichi_cpu):
    spacing = 0.01
    block = lattice((-0.05,) * 3, (0.05,) * 3, spacing)
    wind = (4.0, 4.0, -4.0)
    fluid = make_fluid(
        SPACE, block, gravity=WEIGHTLESS, particle_radius=spacing / 2.0, air_density=AIR, wind=wind,
        artificial_viscosity=0.0,
    )  # fmt: skip
    fluid.begin_frame(0.0)
    fluid.substep(1.0e-4)
    found = fluid.diagnostics()
    velocity = fluid.snapshots()["water"].arrays["velocity"].astype(np.float64)
    within = np.abs(block).max(axis=1) < 0.05 - spacing
    assert (velocity[within] == 0.0).all()
    moved = np.linalg.norm(velocity, axis=1) > 0.0
    # Faces in the lee have no drag; on those towards the wind, -x, -y and +z, all particles have.
    assert (block[moved] * np.sign(wind) < 0.0).any(axis=1).all()
    lee = (block * np.sign(wind)).max(axis=1) > 0.05 - spacing
    towards = (block * np.sign(wind)).min(axis=1) < spacing - 0.05
    assert moved[towards & ~lee].all()
    assert not moved[lee & ~towards].any()
    momentum = np.array([found[f"momentum_{axis}"] for axis in "xyz"])
    gained = np.array([found[f"air_impulse_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(gained, -momentum, rtol=1e-4)
    assert (momentum * wind > 0.0).all()


def test_wind_without_air_is_refused():
    with pytest.raises(ValidationError, match="wind moves nothing without air"):
        FluidParameters.model_validate(
            {"name": "water", "wind": (1, 0, 0), "block": [{"shape": {"type": "sphere", "radius": 1}}]}
        )


def test_fluids_of_a_tank_share_their_air():
    water, oil = (
        FluidParameters.model_validate(
            {"name": name, "air_density": AIR, "wind": wind, "block": [{"shape": {"type": "sphere", "radius": 1}}]}
        )
        for name, wind in (("water", (1, 0, 0)), ("oil", (1, 2, 0)))
    )
    ((number, key, reason),) = shared_conflicts([water, oil])
    assert (number, key) == (1, "wind")
    assert "(1, 2, 0)" in reason
    assert "(1, 0, 0)" in reason


@pytest.mark.parametrize("solver", ["wcsph", "dfsph", "pcisph"])
def test_a_run_in_the_wind_goes_on_from_a_checkpoint_bit_for_bit(taichi_cpu, solver):
    block = lattice((-0.03,) * 3, (0.03,) * 3, 0.01)
    material = {"particle_radius": 0.005, "air_density": AIR, "wind": (9.0, 0.0, 3.0), "solver": solver}
    whole, half = (make_fluid(SPACE, block, gravity=WEIGHTLESS, **material) for _ in range(2))
    for _ in range(5):
        whole.substep(1.0e-3)
    half.restore(whole.checkpoint())
    for fluid in (whole, half):
        fluid.begin_frame(0.0)
        for _ in range(5):
            fluid.substep(1.0e-3)
    one, other = (fluid.snapshots()["water"].arrays for fluid in (whole, half))
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name])
    for axis in "xyz":
        key = f"air_impulse_{axis}"
        assert whole.diagnostics()[key] == half.diagnostics()[key]
