"""What solids leave open of cells and faces."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy import ndimage
from smoke_scenes import CLOSED_BOX, unit_grid

from sim.core.domain import DomainParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.smoke.cut_cells import ALONE, KEEPER, LEAST_VOLUME, is_split
from sim.smoke.grid import SmokeGrid
from sim.smoke.obstacles import Obstacles
from sim.smoke.parameters import SmokeParameters
from sim.smoke.solver import SmokeSolver

pytestmark = pytest.mark.usefixtures("taichi_cpu")

CELLS = (12, 10, 14)


def corners(cells=CELLS) -> np.ndarray:
    """Of cells with edges of 1, (nx + 1, ny + 1, nz + 1, 3)."""
    return np.stack(np.meshgrid(*(np.arange(n + 1.0) for n in cells), indexing="ij"), axis=-1)


def obstacles_at(distance: np.ndarray) -> Obstacles:
    cells = tuple(n - 1 for n in distance.shape)
    return Obstacles(replace(unit_grid(cells, CLOSED_BOX), distance=distance.astype(np.float32)))


def areas(obstacles: Obstacles) -> list[np.ndarray]:
    grid = obstacles.grid
    return [grid.trim(area.to_numpy(), grid.face_shape(axis)) for axis, area in enumerate(obstacles.solids.area)]


def part_below(normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Part of a unit square or cube, from 0 to 1, where normal . x < offset; no component is 0."""
    offset = offset - np.minimum(normal, 0.0).sum()
    normal = np.abs(normal)
    total = np.zeros_like(offset)
    for count in range(len(normal) + 1):
        for chosen in combinations(normal, count):
            total += (-1.0) ** count * np.maximum(offset - sum(chosen), 0.0) ** len(normal)
    return total / (np.prod(normal) * np.prod(np.arange(1, len(normal) + 1)))


@pytest.mark.parametrize("seed", range(4))
def test_a_plane_leaves_exactly_its_parts_open(seed):
    random = np.random.default_rng(seed)
    normal = random.normal(size=3)
    normal /= np.linalg.norm(normal)
    # Little of it is small: such cells may be closed or not, which is another test.
    distance = np.clip(corners() @ normal - np.dot(np.array(CELLS) / 2.0 + random.random(3), normal), -2.0, 2.0)
    obstacles = obstacles_at(distance)
    offset = -distance[:-1, :-1, :-1]
    volume = 1.0 - part_below(normal, offset)
    near = np.abs(offset) < 1.9  # beyond distances are cut off, where no plane is
    cut = near & (volume > LEAST_VOLUME) & (volume < 1.0)
    assert cut.sum() > 50
    assert np.abs(obstacles.open_volume() - volume)[cut].max() < 2.0e-6
    for axis, area in enumerate(areas(obstacles)):
        others = np.delete(normal, axis)
        lowest = np.delete(np.delete(-distance, -1, (axis + 1) % 3), -1, (axis + 2) % 3)
        exact = 1.0 - part_below(others, lowest)
        inner = tuple(slice(1, -1) for _ in range(3))
        cut = ((np.abs(lowest) < 1.0) & (exact > 0.2) & (exact < 1.0))[inner]
        assert cut.sum() > 10
        assert np.abs(area - exact)[inner][cut].max() < 2.0e-6


def test_what_is_mirrored_has_the_same_parts_to_the_bit():
    distance = (np.random.default_rng(3).random([n + 1 for n in CELLS]) - 0.3).astype(np.float32)
    whole = obstacles_at(distance)
    for mirrored in range(3):
        other = obstacles_at(np.flip(distance, mirrored))
        # Keepers may be others, so that a cell is small on one side and closed on the other; parts are the same.
        mine, its = whole.open_volume(), np.flip(other.open_volume(), mirrored)
        assert np.array_equal(mine, its)
        for area, its_area in zip(areas(whole), areas(other), strict=True):
            assert np.array_equal(area, np.flip(its_area, mirrored))


def test_cells_are_split_where_their_open_corners_are_not_connected():
    for outside in range(256):
        bits = np.array([outside >> n & 1 for n in range(8)]).reshape(2, 2, 2)
        assert bool(is_split(np.int64(outside))) == (ndimage.label(bits)[1] > 1), outside


def test_small_cells_have_a_keeper_that_is_not():
    ball = np.linalg.norm(corners() - (6.1, 4.8, 7.3), axis=-1) - 3.7
    obstacles = obstacles_at(np.clip(ball, -2.0, 2.0))
    volume, words = obstacles.open_volume(), obstacles.grid.trim(obstacles.solids.words.to_numpy(), CELLS) & 7
    small = (volume > 0.0) & (volume < LEAST_VOLUME)
    assert small.sum() > 20
    steps = np.array([(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1)])
    for place in np.argwhere(small):
        code = words[tuple(place)]
        assert code not in (ALONE, KEEPER)
        keeper = tuple(place + steps[code - 1])
        assert volume[keeper] >= LEAST_VOLUME
        assert words[keeper] == KEEPER
    assert np.isin(words[volume >= LEAST_VOLUME], (ALONE, KEEPER)).all()


DOMAIN = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.0, 1.0, 1.0))
SOURCE = {"shape": {"type": "sphere", "radius": 0.12}, "position": (0.45, 0.52, 0.25), "temperature": 450.0}


@pytest.mark.parametrize("turn", [(20.0, 12.0, 0.0), (45.0, 0.0, 0.0), (35.26439, 45.0, 7.0)])
def test_no_cell_of_one_side_of_a_turned_wall_touches_one_of_the_other(turn):
    wall = build_solid(
        Placement(shape={"type": "box", "size": (4.0, 4.0, 1.0 / 24)}, position=(0.5, 0.51, 0.487), rotation_deg=turn)
    )
    parameters = SmokeParameters(name="room", cell_size=1 / 24, open_faces=(), source=[SOURCE])
    grid = SmokeGrid.build(parameters, DOMAIN, [wall])
    number = grid.air_regions()
    side = wall.rotation[:, 2] @ (grid.cell_centres() - wall.position).T > 0.0
    far = np.abs(wall.signed_distance(grid.cell_centres())) > 0.5 / 24
    above, below = (set(np.unique(number.ravel()[far & each])) - {0} for each in (side, ~side))
    assert above
    assert below
    assert not above & below


@pytest.mark.slow
def test_smoke_in_a_closed_box_with_turned_solids_is_kept():
    solids = [
        build_solid(Placement(shape=shape, position=position, rotation_deg=(20.0, 35.0, 10.0)))
        for shape, position in (
            ({"type": "box", "size": (0.3, 0.2, 0.1)}, (0.35, 0.55, 0.6)),
            ({"type": "sphere", "radius": 0.17}, (0.68, 0.5, 0.62)),
        )
    ]
    parameters = SmokeParameters(
        name="plume", cell_size=1 / 24, open_faces=(), source=[{**SOURCE, "end_s": 0.3}], cooling=0.0
    )
    solver = SmokeSolver(parameters, domain=DOMAIN, gravity=(0.0, 0.0, -9.81), solids=solids)
    solver.begin_frame(0.0)
    for _ in range(150):
        solver.substep(min(solver.stable_dt(), 1 / 60))
    numbers, density = solver.diagnostics(), solver.snapshots()["plume"].arrays["density"]
    # Rounding alone.
    assert numbers["mass"] == pytest.approx(numbers["emitted_mass"], rel=1.0e-5)
    assert numbers["not_converged"] == 0.0
    assert density.min() >= 0.0
    assert density.max() <= 1.0 + 1.0e-4
