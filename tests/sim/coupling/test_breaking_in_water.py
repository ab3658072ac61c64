"""Bodies that break, in water: one body as long as they hold, and pieces that it pushes after that."""

import numpy as np
import pytest
from coupled_tanks import OPEN_SPACE, WEIGHTLESS, Tank


def struck_box(strength: float | None, solver: str = "dfsph") -> Tank:
    """A light box, whole or of six pieces, that turns in space, and water that flies at a side of it."""
    box = {"kind": "dynamic", "density": 150.0, "shape": {"type": "box", "size": (0.1, 0.16, 0.12)}}
    box |= {"position": (0.0, 0.05, 0.02), "angular_velocity": (1.0, 0.0, 2.0)}
    if strength is not None:
        box["breaks"] = {"strength": strength, "pieces": 6}
    return Tank(
        [box],
        domain=OPEN_SPACE,
        water=((-0.2, -0.06, -0.06), (-0.08, 0.06, 0.06)),
        water_velocity=(2.0, 0.0, 0.0),
        gravity=WEIGHTLESS,
        solver=solver,
        viscosity=1.0e-2,
        wall_friction=2.0,
        frames_per_second=200.0,
    )


def test_water_moves_what_is_glued_as_it_moves_the_whole(taichi_cpu):
    """The water is six times as heavy, and its pressure solve has to know what mass gives way."""
    whole, glued = struck_box(None), struck_box(1.0e9)
    for tank in (whole, glued):
        tank.run(0.06)
    movers = glued.rigid.glue.movers
    assert whole.rigid.bodies.velocity[0, 0] > 1.0
    # Both have the same samples; sums over pieces round in another order, which a splash makes larger.
    np.testing.assert_allclose(movers.velocity[0], whole.rigid.bodies.velocity[0], atol=0.004)
    np.testing.assert_allclose(movers.position[0], whole.rigid.bodies.position[0], atol=0.0003)


@pytest.mark.parametrize("solver", ["dfsph", "wcsph"])
def test_water_breaks_a_body_and_pushes_its_pieces_and_a_restart_goes_on_with_the_same_bits(taichi_cpu, solver):
    tank = struck_box(600.0, solver)
    linear, angular = tank.momentum()
    kept = [tank.world.checkpoint()]
    while not tank.rigid.glue.is_broken.any():
        tank.world.advance_frame()
        kept.append(tank.world.checkpoint())
    broke = tank.world.frame
    for _ in range(4):
        tank.world.advance_frame()
    assert broke > 1
    for frame in (broke - 1, broke):
        again = struck_box(600.0, solver)
        again.world.restore(frame, kept[frame])
        while again.world.frame < tank.world.frame:
            again.world.advance_frame()
        found = again.world.checkpoint()
        for name, array in tank.world.checkpoint().items():
            np.testing.assert_array_equal(array, found[name], err_msg=name)

    pieces = tank.rigid.bodies.velocity[:, 0]
    assert pieces.max() > pieces.min() + 0.5
    linear_after, angular_after = tank.momentum()
    # Pair forces are opposite to float32 rounding; moving overlapping pieces apart changes their angular momentum.
    assert np.abs(linear_after - linear).max() < 1.0e-6 * np.linalg.norm(linear)
    assert np.abs(angular_after - angular).max() < 1.0e-4 * np.linalg.norm(angular)
