"""Light particles that are held under a heavier fluid change places with it."""

import numpy as np
import pytest

from sim.build import build_world
from sim.fluid.exchange import HELD, PATIENCE
from sim.fluid.solvers import SOLVERS
from sim.scene import SceneParameters

SIDE, DEPTH, SPACING = 0.12, 0.08, 0.02


def tank(solver: str, layers: list[tuple[str, float, float, float]], **shared):
    """Fluids in a tank of 6 x 6 particles: name, density, and the heights that each fills [m]."""
    fluids = [
        {
            "name": name,
            "rest_density": density,
            "solver": solver,
            "block": [
                {"shape": {"type": "box", "size": (SIDE, SIDE, top - low)}, "position": (0, 0, 0.5 * (low + top))}
            ],
            **shared,
        }
        for name, density, low, top in layers
    ]
    domain = {"min": (-SIDE / 2, -SIDE / 2, 0.0), "max": (SIDE / 2, SIDE / 2, 0.3)}
    return build_world(SceneParameters.model_validate({"domain": domain, "fluid": fluids}), frames_per_second=60)


def heights(world, name: str):
    return world.snapshots()[name].arrays["position"][:, 2]


@pytest.mark.parametrize(
    ("solver", "duration"),
    [("dfsph", 11.0), *(pytest.param(each, 11.0, marks=pytest.mark.slow) for each in ("pcisph", "wcsph"))],
)
def test_no_oil_stays_on_the_floor_under_water(taichi_cpu, solver, duration):
    world = tank(solver, [("oil", 700.0, 0.0, DEPTH), ("water", 1000.0, DEPTH, 2 * DEPTH)])
    for _ in range(round(60 * duration)):
        world.advance_frame()
    # 40 of 144 stayed on the floor.
    assert np.count_nonzero(heights(world, "oil") < DEPTH - SPACING) == 0
    assert heights(world, "oil").mean() > 1.47 * DEPTH


@pytest.mark.parametrize("solver", [*sorted(SOLVERS)])
def test_a_layer_of_oil_amid_still_water_rises(taichi_cpu, solver):
    half = DEPTH / 2
    world = tank(
        solver,
        [("below", 1000.0, 0.0, half), ("oil", 900.0, half, half + SPACING), ("water", 1000.0, half + SPACING, DEPTH)],
    )
    for _ in range(240):
        world.advance_frame()
    assert np.count_nonzero(heights(world, "oil") > DEPTH - 1.5 * SPACING) >= 32


def test_momentum_is_the_same_when_places_change(taichi_cpu):
    world = tank("wcsph", [("oil", 700.0, 0.0, SPACING), ("water", 1000.0, SPACING, 2 * SPACING)])
    fluid = world.solvers["oil+water"]
    fluid.compute_density()
    particles, count = fluid.particles, fluid.particle_count
    velocity = np.random.default_rng(3).normal(0.0, 1.0e-3, (count, 3)).astype(np.float32)
    fluid.particles.velocity.from_numpy(velocity)
    particles.carried[HELD].fill(2.0 * PATIENCE)

    def state():
        order = particles.order_by_id()
        names = ("phase", "velocity", "position")
        return {name: particles.host(getattr(particles.arrays, name))[order] for name in names}

    before = state()
    assert fluid.exchange.step(particles, fluid.tank.on_device, fluid.forces.acceleration, 1.0e-3)
    after = state()
    # Every particle has its own fluid and velocity, and all of the lower layer has come up.
    for name in ("phase", "velocity"):
        np.testing.assert_array_equal(after[name], before[name])
    rise = after["position"][:, 2] - before["position"][:, 2]
    np.testing.assert_allclose(rise, np.where(before["phase"] == 0, SPACING, -SPACING), atol=1.0e-6)


def test_a_still_wait_that_was_interrupted_goes_on_bit_for_bit(taichi_cpu):
    layers = [("oil", 700.0, 0.0, 2 * SPACING), ("water", 1000.0, 2 * SPACING, 4 * SPACING)]
    world = tank("wcsph", layers)
    for _ in range(40):
        world.advance_frame()
    checkpoint, frame = world.checkpoint(), world.frame
    restored = tank("wcsph", layers)
    restored.restore(frame, checkpoint)
    for _ in range(20):
        world.advance_frame()
        restored.advance_frame()
    for name, array in world.checkpoint().items():
        np.testing.assert_array_equal(array, restored.checkpoint()[name], err_msg=name)


def test_fluids_that_weigh_the_same_have_nothing_to_exchange(taichi_cpu):
    fluid = tank("dfsph", [("a", 1000.0, 0.0, SPACING), ("b", 1000.0, SPACING, 2 * SPACING)]).solvers["a+b"]
    assert fluid.exchange is None
    assert HELD not in fluid.particles.carried
