"""Sand that comes together: it presses where it is dense, not where the grid lets it touch."""

import numpy as np
import pytest
import taichi as ti

from sim.build import build_world
from sim.core.arrays import Floats
from sim.core.launch import kernel
from sim.scene import SceneParameters
from sim.soft.packing import share_before

pytestmark = pytest.mark.usefixtures("taichi_cpu")

CELL, SIDE = 0.01, 0.03


@kernel
def shares(distance: Floats, share: Floats):
    for k in range(distance.shape[0]):
        share[k] = share_before(distance[k])


def test_a_wall_leaves_a_node_the_part_of_its_spline_before_it():
    distances = np.array([-2.0, -1.0, -0.5, -0.2, 0.0, 0.3, 0.5, 1.2, 1.5, 9.0])
    given, found = (ti.ndarray(ti.f32, len(distances)) for _ in range(2))
    given.from_numpy(distances.astype(np.float32))
    shares(given, found)
    x = np.linspace(-1.5, 1.5, 30_001)
    spline = np.where(np.abs(x) < 0.5, 0.75 - x**2, 0.5 * (1.5 - np.abs(x)) ** 2)
    expected = [float(spline[x > -d].sum()) * 1.0e-4 for d in distances]
    np.testing.assert_allclose(found.to_numpy(), expected, atol=1e-4)


def test_poured_sand_rests_at_two_thirds_of_its_density_or_more():
    """Layers that fall one after the other are a cell apart when the grid first lets them touch.

    Half a spacing above a layer that is dense, the next one counts as dense with it: two thirds are found of those that
    fall evenly, where 0.45 would be left by a cell between them.
    """
    high = 3.0 * CELL
    opening = {
        "shape": {"type": "rectangle", "size": (SIDE, SIDE)},
        "position": (0.5 * SIDE, 0.5 * SIDE, 0.08),
        "direction": (0.0, 0.0, -1.0),
        "speed": 0.1,
        "total_volume": SIDE * SIDE * high,
    }
    sand = {"name": "sand", "material": "sand", "young_modulus": 1.0e5, "cell_size": CELL, "friction": 1.0e-4}
    domain = {"min": (0.0, 0.0, 0.0), "max": (SIDE, SIDE, 0.1)}
    scene = {"domain": domain, "soft": [sand | {"emitter": [opening]}], "gravity": (0.0, 0.0, -9.81)}
    world = build_world(SceneParameters.model_validate(scene), frames_per_second=60)
    for _ in range(36):
        world.advance_frame()
    told = world.snapshots()["sand"].arrays
    assert len(told["position"]) == round(SIDE * SIDE * high / (0.5 * CELL) ** 3)
    assert np.linalg.norm(told["velocity"], axis=1).mean() < 0.02
    assert 0.62 < 0.5 * high / told["position"][:, 2].mean() < 1.05
