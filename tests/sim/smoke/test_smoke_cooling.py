"""How smoke loses its heat, and what becomes of a projection that is cut short."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim.core.domain import DomainParameters
from sim.smoke.forces import cool
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

AMBIENT, HOTTEST = 300.0, 1500.0
DOMAIN = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.0, 1.0, 1.0))
SOURCE = {"shape": {"type": "sphere", "radius": 0.2}, "position": (0.5, 0.5, 0.3), "temperature": HOTTEST}


def build(**changes) -> SmokeSolver:
    parameters = SmokeParameters(name="fire", cell_size=1 / 8, source=[SOURCE], ambient_temperature=AMBIENT, **changes)
    return SmokeSolver(parameters, domain=DOMAIN, gravity=(0.0, 0.0, -9.81))


@pytest.mark.parametrize("cooling", [0.0, 1.5])
def test_fire_cools_by_the_fourth_power_of_its_heat_whatever_the_steps(cooling):
    rate, end_s = 3000.0, 0.6
    solver = build(cooling=cooling, radiative_cooling=rate)
    largest = HOTTEST - AMBIENT
    starts = np.array([largest, 800.0, 300.0, 0.0, -20.0])

    def slope(_, excess):
        # Nguyen, Fedkiw & Jensen 2002 for what is hotter than the air; Newton's law for all.
        return -cooling * excess - rate * np.maximum(excess / largest, 0.0) ** 4

    expected = solve_ivp(slope, (0.0, end_s), starts, rtol=1e-10, atol=1e-10).y[:, -1]
    for steps in (1, 40):
        state = {name: np.zeros_like(array) for name, array in solver.checkpoint().items()}
        state["excess_temperature"][4, 4, 1:6] = starts
        solver.restore(state)
        dt = end_s / steps
        for _ in range(steps):
            cool(solver.air, solver.parameters, dt)
        # Both laws together are solved exactly, so only single precision is left, of a power in every step.
        assert solver.checkpoint()["excess_temperature"][4, 4, 1:6] == pytest.approx(expected, rel=2e-5)
    # A fire of 1500 K is down to a third of its heat in that time, smoke of 300 K excess hardly cools by it.
    assert expected[0] < 0.6 * largest
    assert expected[2] > (0.9 if cooling == 0.0 else 0.35) * 300.0


def test_a_projection_at_its_limit_is_counted_and_loses_nothing():
    solver = build(projection_max_iterations=1, projection_tolerance=1e-6)
    solver.begin_frame(0.0)
    for _ in range(3):
        solver.substep(0.01)
    numbers = solver.diagnostics()
    # Nothing moves in the first step, which emits after forces have acted: two solves of an iteration each.
    assert numbers["not_converged"] == 2.0
    assert numbers["iterations"] == 2.0
    assert numbers["residual"] > 1e-6
    assert solver.first_bad_quantity() is None
    # The smoke is there, and its air is as free of divergence as one iteration makes it.
    assert numbers["mass"] > 0.9 * numbers["emitted_mass"] > 0.0
    assert numbers["residual"] < 0.5
