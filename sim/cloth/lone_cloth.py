"""Cloth that meets no cloth: where its patches are and how they move, by which bodies and walls find it."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.loop_costs import NODE_NS
from sim.cloth.patch_motion_kernels import LANES_AT_A_TIME, WIDENED, measure_changes
from sim.cloth.patch_pairs import MARGIN
from sim.cloth.patches import Patches
from sim.cloth.proximity_contacts import ContactList
from sim.cloth.state import ClothState
from sim.host_access import copied
from sim.launch import fast_launch
from sim.reductions import LaneReduction, reduced, runs_on_gpu
from sim.short_loops import is_short
from sim.work_sharing import begin_sharing, next_item, workers_for


class LoneCloth:
    """Does what `SelfCollision` does where there can be no pair of elements: one cloth, which does not collide with
    itself.

    Patches are bounded by their boxes, and their motion by the box of their displacements, without turning. That is
    looser than a fitted motion, and found in one pass over the nodes; bodies look at more patches, and touch the same
    nodes.

    Attributes:
        thickness: the largest [m].

    Args:
        state: the cloth.
        patches: of it.
    """

    def __init__(self, state: ClothState, patches: Patches) -> None:
        self._patches = patches
        m = max(patches.count, 1)
        self._centre, self._shift, self._turn = (ti.Vector.ndarray(3, ti.f32, m) for _ in range(3))
        self._turn.fill(0.0)
        self._radius, self._rest, self._change, self._margin = (ti.ndarray(ti.f32, m) for _ in range(4))
        self._more = ti.ndarray(ti.f32, m)  # `measure_changes` writes it, for pairs of patches; nothing reads it here
        self._taken = ti.ndarray(ti.i32, 1)
        self._maxima = LaneReduction(maxima=2, sums=0)
        self._is_short = is_short(patches.vertex_count, NODE_NS)
        self.begin_frame(state)

    @property
    def motion_arrays(self) -> tuple[ti.Ndarray, ...]:
        """As `PatchPairs.motion_arrays`."""
        return self._centre, self._shift, self._turn, self._radius, self._rest

    def begin_frame(self, state: ClothState) -> None:
        """Margins of contacts are what they are at the start of a run."""
        self.thickness = float(copied(state.thickness).max())
        self._margin.fill(MARGIN * self.thickness)
        self._is_widened = False

    def look(self, state: ClothState) -> float:
        """Note where patches are and how they move in this substep; returns the largest displacement [m], or more."""
        patches, lanes = self._patches, self._maxima.lanes
        partial, lane_count, *_, nodes = self._maxima.tree
        return float(
            bound_patches(
                patches.count, workers_for(lanes.count), self._taken, lanes.items(patches.count),
                lanes.lane_step(patches.count), lanes.item_step(), patches.first_corner, patches.corners,
                state.position, state.displacement, self._centre, self._shift, self._radius, self._rest,
                partial, lane_count, nodes, self._is_short,
            )
        )  # fmt: skip

    def prepare(self, state: ClothState) -> None:
        """There is nothing to list."""

    def find(self, state: ClothState, contacts: ContactList, recovery: float) -> None:
        """There is nothing to find."""

    def measure_changes(self, state: ClothState, predicted: ti.Ndarray) -> tuple[float, float]:
        """As `SelfCollision.measure_changes`: patches that bodies push far may have met others, or a wall."""
        patches, lanes = self._patches, self._maxima.lanes
        partial, lane_count, *_, nodes = self._maxima.tree
        largest, beyond = measure_changes(
            patches.count, workers_for(lanes.count), self._taken, lanes.items(patches.count),
            lanes.lane_step(patches.count), lanes.item_step(), patches.first_corner, patches.corners,
            state.displacement, predicted, 0.0, self._change, self._margin, self._more, partial, lane_count, nodes,
            self._is_short,
        )  # fmt: skip
        return float(largest), float(beyond)

    def follow(self, state: ClothState, *, is_changed: bool) -> None:  # noqa: ARG002  (as `SelfCollision.follow`)
        """A substep is over: margins for the next one follow from what contacts did, as in `SelfCollision`."""
        if is_changed or self._is_widened:
            set_margins(self._patches.count, MARGIN * self.thickness, int(is_changed), self._change, self._margin)
        self._is_widened = is_changed


@fast_launch
@ti.kernel
def bound_patches(
    count: ti.i32, workers: ti.i32, taken: Integers, items: ti.i32, lane_step: ti.i32, item_step: ti.i32,
    first_corner: Integers, corners: Integers, position: Vectors, displacement: Vectors, centre: Vectors,
    shift: Vectors, radius: Floats, rest: Floats, partial: Floats, lanes: ti.i32, nodes: Floats,
    is_short: ti.template(),
) -> ti.f32:  # fmt: skip
    """A sphere around each patch, and one around the displacements of its corners; the longest of these, or more."""
    begin_sharing(taken, 0)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for worker in range(workers):
        lane = next_item(-1, worker, taken, 0, LANES_AT_A_TIME)
        while lane < lanes:
            longest = 0.0
            for k in range(items):
                m = lane * lane_step + k * item_step
                if m < count:
                    i = corners[first_corner[m]]
                    least, most, u_least, u_most = position[i], position[i], displacement[i], displacement[i]
                    for place in range(first_corner[m] + 1, first_corner[m + 1]):
                        x, u = position[corners[place]], displacement[corners[place]]
                        least, most = ti.min(least, x), ti.max(most, x)
                        u_least, u_most = ti.min(u_least, u), ti.max(u_most, u)
                    centre[m], radius[m] = 0.5 * (least + most), 0.5 * (most - least).norm()
                    shift[m], rest[m] = 0.5 * (u_least + u_most), 0.5 * (u_most - u_least).norm()
                    longest = ti.max(longest, shift[m].norm() + rest[m])
            partial[lane] = longest
            lane = next_item(lane, worker, taken, 0, LANES_AT_A_TIME)
    return reduced(partial, lanes, 1, 1, nodes)[0]


@fast_launch
@ti.kernel
def set_margins(count: ti.i32, least: ti.f32, is_changed: ti.i32, change: Floats, margin: Floats):
    """How far contacts may displace the vertices of each patch in the next substep without it being looked at anew:
    `WIDENED` times what they did in this one, and `least` [m] at least.

    On a CPU serial: a patch takes a nanosecond.
    """
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for m in range(count):
        margin[m] = ti.max(least, ti.select(is_changed == 1, WIDENED * change[m], 0.0))
