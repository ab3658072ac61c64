import numpy as np
import pytest
import taichi as ti
from scipy.spatial import cKDTree

from sim.core.cells import CellGrid, CellSort, SortedPoints
from sim.core.neighbors import NeighborList

RADIUS = 0.1


def device(values: np.ndarray) -> ti.Ndarray:
    dtype = ti.i32 if values.dtype == np.int32 else ti.f32
    array = ti.ndarray(dtype, len(values)) if values.ndim == 1 else ti.Vector.ndarray(3, dtype, len(values))
    array.from_numpy(np.ascontiguousarray(values))
    return array


def test_sort_orders_by_cell_then_id_and_drops_what_is_outside(taichi_cpu):
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.05, 1.0, (3000, 3)).astype(np.float32)
    ids = rng.permutation(3000).astype(np.int32)
    grid = CellGrid.covering(np.zeros(3), np.ones(3), RADIUS)
    cells = CellSort(grid, len(points))
    kept = cells.sort(device(points), device(ids), len(points), (0.0, 0.0, 0.0), (2.0, 2.0, 2.0))
    inside = np.flatnonzero((points >= 0.0).all(axis=1))
    assert kept == len(inside)
    cell = np.floor((points - np.float32(grid.origin)) * np.float32(1.0 / RADIUS)).astype(int)
    index = (cell[:, 2] * grid.shape[1] + cell[:, 1]) * grid.shape[0] + cell[:, 0]
    expected = inside[np.lexsort((ids[inside], index[inside]))]
    np.testing.assert_array_equal(cells.order.to_numpy()[:kept], expected)


@pytest.mark.parametrize("size", [(1.0e3, 1.0, 1.0e3), (1.0e30, 1.0, 1.0)])
def test_a_box_of_too_many_cells_is_refused(size):
    with pytest.raises(ValueError, match=r"smaller .* or .* larger"):
        CellGrid.covering(np.zeros(3), np.array(size), 0.01)


def test_a_box_of_as_many_cells_as_fit_is_taken():
    assert CellGrid.covering(np.zeros(3), np.array([1022.0, 1022.0, 254.0]), 1.0).cell_count == 2**28


@pytest.mark.parametrize(("depth", "reach", "cell_size"), [(126.0, 2, 0.5), (126.1, 1, 1.0)])
def test_a_box_of_too_many_half_sized_cells_gets_whole_ones(depth, reach, cell_size):
    grid = CellGrid.covering(np.zeros(3), np.array([510.0, 510.0, depth]), 1.0, reach=2)
    assert (grid.reach, grid.cell_size) == (reach, cell_size)


def test_a_box_of_too_many_whole_cells_is_refused_however_fine_they_were_wanted():
    with pytest.raises(ValueError, match=r"neighbour cells of 1 m"):
        CellGrid.covering(np.zeros(3), np.array([1022.0, 1022.0, 254.1]), 1.0, reach=2)


def find_neighbors(
    points: np.ndarray, boundary: np.ndarray, moving: np.ndarray | None = None, *, stride: int = 1, reach: int = 1
) -> tuple[list[set[int]], list[set[int]], np.ndarray, np.ndarray]:
    """Neighbours by the device: of fluid, of boundary, with both point sets as sorted; moving samples come last."""
    grid = CellGrid.covering(np.zeros(3), np.ones(3), RADIUS, reach=reach)
    clouds, orders, ordered = [], [], []
    for cloud in (points, boundary, moving):
        if cloud is None:
            continue
        cells = CellSort(grid, len(cloud))
        cells.sort(device(cloud), device(np.arange(len(cloud), dtype=np.int32)), len(cloud), (-9.0,) * 3, (9.0,) * 3)
        orders.append(cells.order.to_numpy())
        ordered.append(cloud[orders[-1]])
        clouds.append(SortedPoints(*(device(ordered[-1][:, axis]) for axis in range(3)), cells.cell_start))
    found = NeighborList(grid, len(points), stride=stride)
    index = device((len(boundary) + orders[-1]).astype(np.int32))
    found.build(RADIUS, clouds[0], len(points), clouds[1], None if moving is None else clouds[2], index)
    start, near, solid_near = (each.to_numpy() for each in found.lists[:3])
    indices = found.lists.indices.to_numpy()
    places = [start[i] + stride * np.arange(near[i] + solid_near[i]) for i in range(len(points))]
    taken = np.concatenate(places)
    assert len(np.unique(taken)) == len(taken)  # no place twice
    assert taken.max(initial=0) < found.length
    fluid = [set(indices[places[i][: near[i]]].tolist()) for i in range(len(points))]
    solid = [set(indices[places[i][near[i] :]].tolist()) for i in range(len(points))]
    assert sum(map(len, fluid)) == near.sum()  # nobody twice
    assert sum(map(len, solid)) == solid_near.sum()
    samples = ordered[1] if moving is None else np.concatenate([ordered[1], moving])
    return fluid, solid, ordered[0], samples


@pytest.mark.parametrize(
    ("stride", "reach", "moving_count"), [(1, 1, 0), (1, 1, 300), (1, 2, 300), (32, 1, 300), (32, 2, 0), (32, 2, 300)]
)
def test_neighbors_equal_those_of_a_search_tree(taichi_cpu, stride, moving_count, reach):
    rng = np.random.default_rng(3)
    points = rng.uniform(0.0, 1.0, (2000, 3)).astype(np.float32)
    boundary = rng.uniform(-0.1, 1.1, (800, 3)).astype(np.float32)
    moving = rng.uniform(0.3, 0.6, (moving_count, 3)).astype(np.float32) if moving_count else None
    fluid, solid, points, boundary = find_neighbors(points, boundary, moving, stride=stride, reach=reach)
    tree, boundary_tree = cKDTree(points), cKDTree(boundary)
    # Pairs whose distance is the radius to float32 rounding may fall on either side; this seed has none.
    assert fluid == [set(near) - {i} for i, near in enumerate(tree.query_ball_point(points, RADIUS))]
    assert solid == [set(near) for near in boundary_tree.query_ball_point(points, RADIUS)]


# A GPU's list is interleaved and may come from half-sized cells, which are searched in another way.
@pytest.mark.parametrize(("stride", "reach"), [(1, 1), (32, 1), (32, 2)])
def test_a_thousand_particles_in_one_spot_do_not_overflow(taichi_cpu, stride, reach):
    points = np.full((1000, 3), 0.5, dtype=np.float32)
    fluid, _, _, _ = find_neighbors(points, np.full((1, 3), 0.9, dtype=np.float32), stride=stride, reach=reach)
    assert all(len(near) == 999 for near in fluid)


@pytest.mark.parametrize(("stride", "reach"), [(1, 1), (32, 1), (32, 2)])
def test_a_particle_at_nan_finds_nobody_and_keeps_a_place_of_its_own(taichi_cpu, stride, reach):
    points = np.random.default_rng(4).uniform(0.0, 1.0, (500, 3)).astype(np.float32)
    for k, axis in enumerate((0, 1, 2, slice(None))):
        points[100 * k, axis] = np.nan
    fluid, solid, points, _ = find_neighbors(points, np.full((1, 3), 0.9, dtype=np.float32), stride=stride, reach=reach)
    lost = np.isnan(points).any(axis=1)
    assert lost.sum() == 4
    assert all(len(fluid[i]) + len(solid[i]) == 0 for i in np.flatnonzero(lost))
    there = np.flatnonzero(~lost)
    tree = cKDTree(points[there])
    for i, near in zip(there, tree.query_ball_point(points[there], RADIUS), strict=True):
        assert fluid[i] == set(there[near].tolist()) - {i}


def test_more_neighbors_than_a_list_can_index_are_refused(taichi_cpu):
    points = np.full((47_000, 3), 0.5, dtype=np.float32)  # 47 000² is just above 2³¹
    with pytest.raises(OverflowError, match="47000 particles"):
        find_neighbors(points, np.full((1, 3), 0.9, dtype=np.float32))
