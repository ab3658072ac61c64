"""Forces on bodies and sheets: none are asked for where no particle is near, and those that are wait on the device."""

import numpy as np
import pytest
from cloth_tanks import ClothTank, rectangle
from coupled_tanks import SPACING, Tank

from sim.core.domain import DomainParameters
from sim.fluid.body_forces import KEPT, BodyForces

SIDE = 4 * SPACING


def a_ball_above_water(solver: str) -> Tank:
    """It touches after some ten steps."""
    domain = DomainParameters(min=(-SIDE, -SIDE, 0.0), max=(SIDE, SIDE, 0.4))
    ball = {"kind": "dynamic", "density": 300.0, "shape": {"type": "sphere", "radius": 2.0 * SPACING}}
    return Tank(
        [{**ball, "position": (0.0, 0.0, 0.16), "velocity": (0.0, 0.0, -1.0)}],
        domain=domain,
        water=(domain.min, (SIDE, SIDE, 4 * SPACING)),
        solver=solver,
        frames_per_second=200.0,
    )


def a_sheet_that_leaves_a_drop(solver: str) -> ClothTank:
    """It touches the drop by an edge, is drawn away sideways, and comes back in the end."""
    everywhere = {"region": {"type": "box", "min": (-1.0, -1.0, -1.0), "max": (1.0, 1.0, 1.0)}}
    places = {0.0: 0.0, 0.02: 0.15, 0.07: 0.15, 0.09: 0.0}
    path = [{"time_s": time_s, "offset": (x, 0.0, 0.0)} for time_s, x in places.items()]
    return ClothTank(
        cloth={"shape": rectangle(0.08, 5), "position": (0.085, 0.0, 0.16), "pin": [{**everywhere, "keyframe": path}]},
        water=((-0.04, -0.04, 0.12), (0.04, 0.04, 0.2)),
        domain={"min": (-0.3, -0.3, 0.0), "max": (0.3, 0.3, 0.6)},
        gravity=(0.0, 0.0, 0.0),
        solver=solver,
    )


@pytest.mark.parametrize("scene", [a_ball_above_water, a_sheet_that_leaves_a_drop])
@pytest.mark.parametrize("solver", ["dfsph", pytest.param("wcsph", marks=pytest.mark.slow)])
def test_what_is_not_asked_for_would_have_changed_no_bit(taichi_cpu, monkeypatch, scene, solver):
    seen = set()

    def checkpoint(*, skips: bool) -> dict[str, np.ndarray]:
        tank = scene(solver)
        forces = tank.fluid.body_forces
        if not skips:
            monkeypatch.setattr(BodyForces, "are_alone", property(lambda _: False, lambda *_: None), raising=False)
        for _ in range(6):
            tank.world.advance_frame()
            seen.add((skips, forces.are_alone))
        return tank.world.checkpoint()

    found, expected = checkpoint(skips=True), checkpoint(skips=False)
    assert seen == {(True, True), (True, False), (False, False)}
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def test_forces_that_wait_on_the_device_count_once_each(taichi_cpu):
    domain = DomainParameters(min=(-SIDE, -SIDE, 0.0), max=(SIDE, SIDE, 0.3))
    ball = {"kind": "kinematic", "shape": {"type": "sphere", "radius": 2.0 * SPACING}, "position": (0.0, 0.0, 0.08)}
    fluid = Tank([ball], domain=domain, water=(domain.min, (SIDE, SIDE, 0.16)), solver="dfsph").fluid
    fluid.compute_density()
    pressure = fluid.particles.carried["pressure"]
    pressure.from_numpy(np.random.default_rng(1).uniform(0.0, 1000.0, fluid.particles.capacity).astype(np.float32))
    fluid.forces.react(pressure, 0.5)
    one = np.concatenate(fluid.body_forces.take_impulses())
    assert np.abs(one).max() > 0.0
    for _ in range(KEPT + 2):  # more than there is room for
        fluid.forces.react(pressure, 0.5)
    np.testing.assert_allclose(np.concatenate(fluid.body_forces.take_impulses()), (KEPT + 2) * one, rtol=1.0e-12)
    np.testing.assert_array_equal(np.concatenate(fluid.body_forces.take_impulses()), 0.0)
