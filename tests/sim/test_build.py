"""From a scene to the particles that it starts with."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sim.build import build_world
from sim.fluid.filling import fill_fluids
from sim.fluid.kernels import evaluate, particle_volume
from sim.rigid.states import StaticBody
from sim.scene import SceneParameters

SPACING = 0.02


def scene(*blocks: dict, rigid: tuple[dict, ...] = ()) -> SceneParameters:
    return SceneParameters(fluid=({"name": "water", "block": blocks},), rigid=rigid)


def filling(scene: SceneParameters):
    return fill_fluids(scene.fluid, scene.domain, [StaticBody(body).solid for body in scene.rigid])


def box(size: tuple[float, float, float], position: tuple[float, float, float], **more) -> dict:
    return {"shape": {"type": "box", "size": size}, "position": position, **more}


def test_a_box_of_ten_spacings_holds_a_thousand_particles():
    assert len(filling(scene(box((0.2, 0.2, 0.2), (0, 0, 0.5)))).positions) == 1000


def test_particles_keep_their_radius_from_walls():
    positions = filling(scene(box((2.0, 2.0, 0.3), (0, 0, 0.1)))).positions
    # The domain spans -0.5..0.5; float32 rounding of 0.5 is far below a micrometre.
    assert np.abs(positions[:, :2]).max() <= 0.5 - SPACING / 2 + 1e-6
    assert positions[:, 2].min() >= SPACING / 2 - 1e-6


def test_a_block_that_stands_on_the_floor_loses_no_layer():
    positions = filling(scene(box((0.2, 0.2, 0.2), (0, 0, 0.1)))).positions
    assert len(positions) == 1000
    # Half a spacing above the floor, in float32.
    assert positions[:, 2].min() == pytest.approx(SPACING / 2, abs=1e-6)


def test_a_block_as_large_as_the_domain_fills_it():
    tank = {"min": (-0.1, -0.1, 0.0), "max": (0.1, 0.1, 0.2)}
    whole = SceneParameters(domain=tank, fluid=scene(box((0.2, 0.2, 0.2), (0, 0, 0.1))).fluid)
    assert len(filling(whole).positions) == 1000


def test_particles_inside_a_solid_are_left_out():
    ball = {"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "position": (0, 0, 0.5)}
    without = filling(scene(box((0.4, 0.4, 0.4), (0, 0, 0.5))))
    with_ball = filling(scene(box((0.4, 0.4, 0.4), (0, 0, 0.5)), rigid=(ball,)))
    left_out = len(without.positions) - len(with_ball.positions)
    # As many as the ball displaces, 524; its volume is measured in cells of half a spacing.
    assert left_out == pytest.approx(4 / 3 * np.pi * 0.1**3 / SPACING**3, rel=0.01)
    # One part in a thousand of the radius is allowed for rounding.
    assert np.linalg.norm(with_ball.positions - [0, 0, 0.5], axis=1).min() >= 0.1 + 0.999 * SPACING / 2 - 1e-6


@pytest.mark.parametrize(
    ("corner", "shared", "nearest", "densest"),
    [
        ((0.053, 0.011, 0.507), 0.147 * 0.189 * 0.193, 0.9, 1.01),
        ((0.101, 0.099, 0.51), 0.099 * 0.101 * 0.19, 0.9, 1.04),
        ((0.08, 0.083, 0.57), 0.12 * 0.117 * 0.13, 0.75, 1.04),
        ((0.037, 0.1, 0.55), 0.163 * 0.1 * 0.15, 0.9, 1.09),
    ],
)
def test_overlapping_blocks_share_no_place(corner, shared, nearest, densest):
    """Nor is fluid much denser where they meet: the corner of a full box between walls has 1.06."""
    result = filling(scene(box((0.2, 0.2, 0.2), (0, 0, 0.5)), box((0.2, 0.2, 0.2), corner)))
    # Of both together, without what they share.
    assert len(result.positions) == pytest.approx(2000 - shared / SPACING**3, rel=2e-3)
    positions = result.positions.astype(np.float64)
    distance, _ = cKDTree(positions).query(positions, k=2)
    assert distance[:, 1].min() >= nearest * SPACING - 1e-6
    pairs = cKDTree(positions).query_pairs(2.0 * SPACING, output_type="ndarray")
    apart = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    weights = np.bincount(pairs.T.ravel(), np.tile(evaluate(apart, 2.0 * SPACING), 2), minlength=len(positions))
    density = particle_volume(SPACING) * (evaluate(0.0, 2.0 * SPACING) + weights)
    assert density.max() < densest


def test_each_block_keeps_its_own_velocity():
    result = filling(
        scene(
            box((0.1, 0.1, 0.1), (-0.3, 0, 0.5), velocity=(1, 0, 0)),
            box((0.1, 0.1, 0.1), (0.3, 0, 0.5), velocity=(0, 2, 0)),
        )
    )
    left = result.positions[:, 0] < 0
    np.testing.assert_array_equal(result.velocities[left], np.broadcast_to([1, 0, 0], (125, 3)))
    np.testing.assert_array_equal(result.velocities[~left], np.broadcast_to([0, 2, 0], (125, 3)))


@pytest.mark.usefixtures("taichi_cpu")
def test_a_fluid_without_a_free_place_is_refused():
    block = {"name": "block", "shape": {"type": "box", "size": (0.6, 0.6, 0.6)}, "position": (0, 0, 0.5)}
    with pytest.raises(ValueError, match=r'fluid "water" block\[0\] has no particle'):
        build_world(scene(box((0.1, 0.1, 0.1), (0, 0, 0.5)), rigid=(block,)), frames_per_second=60)


@pytest.mark.usefixtures("taichi_cpu")
def test_a_body_that_reaches_out_of_the_domain_holds_the_fluid_back_inside():
    pillar = {"name": "pillar", "shape": {"type": "box", "size": (0.2, 0.2, 3.0)}, "position": (-0.45, 0, 0.5)}
    far = {"name": "far", "shape": {"type": "sphere", "radius": 0.3}, "position": (5, 5, 5)}
    water = box((0.12, 0.2, 0.1), (-0.28, 0, 0.06), velocity=(-1, 0, 0))
    world = build_world(scene(water, rigid=(pillar, far)), frames_per_second=60)
    for _ in range(4):
        world.advance_frame()
    positions = world.snapshots()["water"].arrays["position"]
    inside_pillar = (positions[:, 0] < -0.35) & (np.abs(positions[:, 1]) < 0.1)
    assert not inside_pillar.any()


def test_rigid_bodies_alone_are_left_to_the_cpu():
    """A GPU took three to five times as long for a thousand boxes as its machine's cores."""
    ball = {"name": "ball", "shape": {"type": "sphere", "radius": 0.1}}
    smoke = {"name": "smoke", "source": [{"shape": {"type": "sphere", "radius": 0.1}}]}
    assert SceneParameters.model_validate({"rigid": [ball]}).chosen_device == "cpu"
    assert SceneParameters.model_validate({"rigid": [ball], "device": "cuda"}).chosen_device == "cuda"
    assert SceneParameters.model_validate({"rigid": [ball], "smoke": [smoke]}).chosen_device == "auto"
