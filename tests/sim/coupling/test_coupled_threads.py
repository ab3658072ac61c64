"""Coupled steps give the same bits whatever the number of threads."""

import pytest
from cloth_tanks import EDGES, ClothTank, rectangle
from coupled_tanks import Tank
from thread_counts import digest_of, result_on_any_threads

from sim.core.domain import DomainParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")


def ball_in_water(solver: str) -> tuple[str, float]:
    ball = {"kind": "dynamic", "density": 300.0, "shape": {"type": "sphere", "radius": 0.09}}
    tank = Tank(
        [{**ball, "position": (0.15, 0.18, 0.28), "velocity": (0.0, 0.0, -1.0)}],
        domain=DomainParameters(min=(0.0, 0.0, 0.0), max=(0.36, 0.36, 0.6)),
        water=((0.0, 0.0, 0.0), (0.36, 0.36, 0.2)),
        solver=solver,
        wall_friction=1.0,
    )
    for _ in range(15):
        tank.step()
    return digest_of(tank.world.checkpoint()), float(abs(tank.coupling.force).max())


def water_on_cloth() -> tuple[str, float]:
    tank = ClothTank(
        cloth={"shape": rectangle(0.16, 9), "position": (0.0, 0.0, 0.1), "mass_per_area": 0.2, "pin": EDGES},
        water=((-0.08, -0.08, 0.12), (0.08, 0.08, 0.2)),
        solver="dfsph",
        wall_friction=1.0,
        domain={"min": (-0.08, -0.08, 0.0), "max": (0.08, 0.08, 0.3)},
    )
    tank.run(0.02)
    return digest_of(tank.world.checkpoint()), float(abs(tank.coupling.impulse()).max())


def coupled_digests() -> list[tuple[str, float]]:
    return [*map(ball_in_water, ("wcsph", "dfsph", "pcisph")), water_on_cloth()]


@pytest.mark.slow
def test_fluid_with_bodies_and_with_cloth_does_not_depend_on_the_number_of_threads():
    assert min(push for _, push in result_on_any_threads(coupled_digests)) > 0.0
