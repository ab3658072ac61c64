"""Cloth that meets no cloth: where its patches are and how they move, by which bodies and walls find it."""

import taichi as ti

from sim.cloth.bundles import PatchMotion, PatchNodes
from sim.cloth.loop_costs import NODE_NS
from sim.cloth.patch_motion_kernels import LANES_AT_A_TIME, WIDENED, measure_changes
from sim.cloth.patch_pairs import MARGIN
from sim.cloth.patches import Patches
from sim.cloth.proximity_contacts import ContactList
from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Integers, Vectors
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Share, reduced, runs_on_gpu
from sim.core.scheduling import begin_sharing, is_short, next_item, workers_for


class LoneCloth:
    """Does what `SelfCollision` does where there can be no pair of elements: one cloth, which does not collide with
    itself.

    Patches are bounded by their boxes, and their motion by the box of their displacements, without turning. That is
    looser than a fitted motion, and found in one pass over the nodes; bodies look at more patches, and touch the same
    nodes.

    Attributes:
        thickness: the largest [m].
        motion: of the patches in the substep, without turns.

    Args:
        state: the cloth.
        patches: of it.
    """

    def __init__(self, state: ClothState, patches: Patches) -> None:
        self._patches = patches
        m = max(patches.count, 1)
        vectors, floats = (lambda: ti.Vector.ndarray(3, ti.f32, m)), (lambda: ti.ndarray(ti.f32, m))
        self.motion = PatchMotion(vectors(), vectors(), vectors(), floats(), floats())
        self.motion.turn.fill(0.0)
        self._change, self._margin = floats(), floats()
        self._more = floats()  # `measure_changes` writes it, for pairs of patches; nothing reads it here
        self._taken = ti.ndarray(ti.i32, 1)
        self._maxima = LaneReduction(maxima=2, sums=0)
        self._is_short = is_short(patches.vertex_count, NODE_NS)
        self.begin_frame(state)

    def begin_frame(self, state: ClothState) -> None:
        """Margins of contacts are what they are at the start of a run."""
        self.thickness = float(copied(state.thickness).max())
        self._margin.fill(MARGIN * self.thickness)
        self._is_widened = False

    def look(self, state: ClothState) -> float:
        """Note where patches are and how they move in this substep; returns the largest displacement [m], or more."""
        patches = self._patches
        return float(
            bound_patches(
                self._maxima.over(patches.count),
                workers_for(self._maxima.lanes.count),
                self._taken,
                patches.corner_lists,
                state.position,
                state.displacement,
                self.motion,
                self._is_short,
            )
        )

    def prepare(self, state: ClothState) -> None:
        """There is nothing to list."""

    def find(self, state: ClothState, contacts: ContactList, recovery: float) -> None:
        """There is nothing to find."""

    def measure_changes(self, state: ClothState, predicted: ti.Ndarray) -> tuple[float, float]:
        """As `SelfCollision.measure_changes`: patches that bodies push far may have met others, or a wall."""
        patches = self._patches
        largest, beyond = measure_changes(
            self._maxima.over(patches.count),
            workers_for(self._maxima.lanes.count),
            self._taken,
            patches.corner_lists,
            state.displacement,
            predicted,
            0.0,
            self._change,
            self._margin,
            self._more,
            self._is_short,
        )
        return float(largest), float(beyond)

    def follow(self, state: ClothState, *, is_changed: bool) -> None:  # noqa: ARG002  (as `SelfCollision.follow`)
        """A substep is over: margins for the next one follow from what contacts did, as in `SelfCollision`."""
        if is_changed or self._is_widened:
            set_margins(self._patches.count, MARGIN * self.thickness, int(is_changed), self._change, self._margin)
        self._is_widened = is_changed


@kernel
def bound_patches(
    share: Share,
    workers: ti.i32,
    taken: Integers,
    corners: PatchNodes,
    position: Vectors,
    displacement: Vectors,
    patches: PatchMotion,
    is_short: ti.template(),
) -> ti.f32:
    """A sphere around each patch, and one around the displacements of its corners; the longest of these, or more."""
    begin_sharing(taken, 0)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for worker in range(workers):
        lane = next_item(-1, worker, taken, 0, LANES_AT_A_TIME)
        while lane < share.tree.lanes:
            longest = 0.0
            for k in range(share.items):
                m = lane * share.lane_step + k * share.item_step
                if m < corners.count:
                    i = corners.nodes[corners.first[m]]
                    least, most, u_least, u_most = position[i], position[i], displacement[i], displacement[i]
                    for place in range(corners.first[m] + 1, corners.first[m + 1]):
                        x, u = position[corners.nodes[place]], displacement[corners.nodes[place]]
                        least, most = ti.min(least, x), ti.max(most, x)
                        u_least, u_most = ti.min(u_least, u), ti.max(u_most, u)
                    patches.centre[m], patches.radius[m] = 0.5 * (least + most), 0.5 * (most - least).norm()
                    patches.shift[m], patches.rest[m] = 0.5 * (u_least + u_most), 0.5 * (u_most - u_least).norm()
                    longest = ti.max(longest, patches.shift[m].norm() + patches.rest[m])
            share.tree.partial[lane] = longest
            lane = next_item(lane, worker, taken, 0, LANES_AT_A_TIME)
    return reduced(share.tree.partial, share.tree.lanes, 1, 1, share.tree.nodes)[0]


@kernel
def set_margins(count: ti.i32, least: ti.f32, is_changed: ti.i32, change: Floats, margin: Floats):
    """How far contacts may displace the vertices of each patch in the next substep without it being looked at anew:
    `WIDENED` times what they did in this one, and `least` [m] at least.

    On a CPU serial: a patch takes a nanosecond.
    """
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for m in range(count):
        margin[m] = ti.max(least, ti.select(is_changed == 1, WIDENED * change[m], 0.0))
