"""Particles that fill volumes: their number, how near to walls and to each other they are, their density."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sim.fluid.kernels import evaluate, particle_volume
from sim.shapes.filled_volume import Surroundings, amount, pack
from sim.shapes.parameters import Placement
from sim.shapes.placement import PlacedSolid, build_solid
from sim.shapes.solid import ShapeError

SPACINGS = (0.04, 0.026, 0.02, 0.0142)
AIR = Surroundings(np.full(3, -10.0), np.full(3, 10.0))
TANK = Surroundings(np.full(3, -0.15), np.full(3, 0.15))
NOTHING = np.empty((0, 3))
CUBE = {"type": "box", "size": (0.3, 0.3, 0.3)}
BALL = {"type": "sphere", "radius": 0.08}


def solid(shape: dict, **placement: object) -> PlacedSolid:
    return build_solid(Placement.model_validate({"shape": shape, **placement}))


def density(points: np.ndarray, spacing: float) -> np.ndarray:
    """Relative to that of a filled lattice."""
    pairs = cKDTree(points).query_pairs(2.0 * spacing, output_type="ndarray")
    weight = evaluate(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1), 2.0 * spacing)
    total = np.full(len(points), evaluate(0.0, 2.0 * spacing))
    for column in (0, 1):
        np.add.at(total, pairs[:, column], weight)
    return particle_volume(spacing) * total


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        (CUBE, 0.3**3),
        ({"type": "box", "size": (0.31, 0.17, 0.23)}, 0.31 * 0.17 * 0.23),
        ({"type": "sphere", "radius": 0.15}, 4.0 / 3.0 * np.pi * 0.15**3),
        ({"type": "cylinder", "radius": 0.12, "height": 0.29}, np.pi * 0.12**2 * 0.29),
        ({"type": "torus", "major_radius": 0.2, "minor_radius": 0.07}, 2.0 * np.pi**2 * 0.2 * 0.07**2),
        ({"type": "bunny", "height": 0.3}, None),  # a mesh
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
@pytest.mark.parametrize("turned", [(0, 0, 0), (20, 30, 10)], ids=["upright", "turned"])
def test_a_shape_holds_its_volume_to_a_particle(shape, volume, spacing, turned):
    filled = solid(shape, rotation_deg=turned, position=(0.1, 0.2, 0.3))
    points = pack(filled, spacing, AIR, NOTHING).astype(np.float64)
    meant = (filled.volume if volume is None else volume) / spacing**3
    assert len(points) == pytest.approx(meant, abs=0.51)
    assert amount(filled, spacing, AIR).particles == len(points)
    # Nobody is farther out than half a spacing, and nowhere there is much more than in a lattice.
    assert filled.signed_distance(points).max() < 0.5 * spacing
    assert cKDTree(points).query(points, k=2)[0][:, 1].min() > 0.9 * spacing
    assert density(points, spacing).max() < 1.02


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("walls", [(), (BALL,)], ids=["empty", "around a ball"])
def test_nothing_is_nearer_to_a_wall_than_at_rest(spacing, walls):
    tank = Surroundings(TANK.lower, TANK.upper, [solid(wall) for wall in walls])
    points = pack(solid(CUBE), spacing, tank, NOTHING).astype(np.float64)
    assert tank.room(points).min() >= 0.499 * spacing
    volume = 0.3**3 - sum(4.0 / 3.0 * np.pi * wall["radius"] ** 3 for wall in walls)
    # Of a body in the way the volume is measured in cells of half a spacing.
    assert len(points) * spacing**3 == pytest.approx(volume, rel=2e-3 if walls else 0.0, abs=0.51 * spacing**3)
    assert cKDTree(points).query(points, k=2)[0][:, 1].min() > 0.7 * spacing


def test_a_box_of_whole_spacings_is_the_cubic_lattice():
    points = pack(solid({"type": "box", "size": (0.2, 0.1, 0.06)}), 0.02, AIR, NOTHING)
    assert len(points) == 10 * 5 * 3
    axis = np.arange(10) * 0.02 - 0.09
    np.testing.assert_allclose(np.unique(points[:, 0].round(6)), axis, atol=1e-6)


def test_the_last_layer_of_a_box_lies_on_top_and_is_partly_empty():
    points = pack(solid(CUBE), 0.04, AIR, NOTHING)
    heights, counts = np.unique(points[:, 2].round(5), return_counts=True)
    assert len(heights) == 8
    assert (counts[:-1] == 56).all()
    assert counts[-1] == 422 - 7 * 56
    top = points[points[:, 2] > heights[-2] + 0.01]
    # They lie all over it.
    for axis in (0, 1):
        assert abs(top[:, axis].mean()) < 0.03


@pytest.mark.parametrize("thickness", [0.01, 0.03, 0.05])
def test_a_puddle_thinner_than_a_particle_has_its_mass(thickness):
    points = pack(solid({"type": "box", "size": (1.0, 1.0, thickness)}), 0.04, AIR, NOTHING)
    assert len(points) == pytest.approx(thickness / 0.04**3, abs=0.51)


def test_what_two_volumes_share_belongs_to_the_first():
    first, second = solid(CUBE), solid({**CUBE, "size": (0.37, 0.3, 0.3)}, position=(0.1, 0.02, 0.0))
    own = pack(first, 0.02, AIR, NOTHING)
    around = Surroundings(AIR.lower, AIR.upper, (), [first])
    other = pack(second, 0.02, around, own)
    shared = (0.15 - (0.1 - 0.185)) * 0.28 * 0.3
    assert len(other) * 0.02**3 == pytest.approx(0.37 * 0.3 * 0.3 - shared, rel=2e-3)
    # A few of the second are squeezed between the first and the others; the density is right.
    assert cKDTree(own).query(other)[0].min() > 0.5 * 0.02
    assert density(np.concatenate([own, other]).astype(np.float64), 0.02).max() < 1.05


def test_the_domain_clips():
    around = Surroundings(np.array([-1.0, -1.0, 0.0]), np.array([0.1, 1.0, 1.0]))
    ball = solid({"type": "sphere", "radius": 0.2})
    points = pack(ball, 0.02, around, NOTHING)
    assert around.room(points.astype(np.float64)).min() >= 0.499 * 0.02
    # Half of the ball, without the cap beyond x = 0.1: pi h² (3 r - h) / 3 with h = 0.1.
    half, cap = 2.0 / 3.0 * np.pi * 0.2**3, np.pi * 0.01 * 0.5 / 3.0
    assert len(points) * 0.02**3 == pytest.approx(half - 0.5 * cap, rel=5e-3)


def test_filling_beyond_all_bounds_is_refused():
    with pytest.raises(ShapeError, match="lattice points; use a larger spacing or a smaller volume"):
        pack(solid(BALL), 1.0e-5, AIR, NOTHING)
