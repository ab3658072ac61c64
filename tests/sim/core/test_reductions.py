import numpy as np
import pytest

from sim.core.launch import kernel
from sim.core.reductions import MAX_QUANTITIES, LaneReduction, Results, Tree, reduced_tree


@kernel
def reduce_lanes(tree: Tree) -> Results:
    return reduced_tree(tree)


def test_results_are_the_maxima_then_the_sums_of_the_lanes(taichi_cpu):
    reduction = LaneReduction(maxima=3, sums=MAX_QUANTITIES - 3)
    lanes = reduction.lanes.count
    # Whole numbers: their sums, below 2^24, are exact in any order.
    values = np.random.default_rng(1).integers(-999, 1000, (MAX_QUANTITIES, lanes)).astype(np.float32)
    reduction.partial.from_numpy(values.ravel())
    expected = np.concatenate([values[:3].max(axis=1), values[3:].sum(axis=1)])
    np.testing.assert_array_equal(reduction.unpack(reduce_lanes(reduction.tree)), expected)


def test_fewer_quantities_leave_no_trace_of_others(taichi_cpu):
    reduction = LaneReduction(maxima=0, sums=1)
    reduction.partial.fill(1.0)
    np.testing.assert_array_equal(reduction.unpack(reduce_lanes(reduction.tree)), [reduction.lanes.count])


def test_a_reduction_refuses_more_quantities_than_it_can_return(taichi_cpu):
    with pytest.raises(ValueError, match=f"at most {MAX_QUANTITIES}"):
        LaneReduction(maxima=MAX_QUANTITIES, sums=1)


@pytest.mark.parametrize("length", [1, 100, 1000])
def test_every_number_belongs_to_one_lane(taichi_cpu, length):
    lanes = LaneReduction(maxima=0, sums=1).lanes
    step, items = lanes.lane_step(length), lanes.items(length)
    owned = [lane * step + k * lanes.item_step() for lane in range(lanes.count) for k in range(items)]
    assert sorted(i for i in owned if i < length) == list(range(length))
