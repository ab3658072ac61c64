"""Cloth that meets no cloth: where its patches are and how they move, by which bodies and walls find it."""

from collections.abc import Callable, Sequence

import taichi as ti

from sim.cloth.bundles import PatchMotion, PatchNodes
from sim.cloth.contact_end import end_lone_contacts
from sim.cloth.loop_costs import NODE_NS
from sim.cloth.patch_pairs import MARGIN
from sim.cloth.patches import Patches
from sim.cloth.proximity_contacts import ContactList
from sim.cloth.state import ClothState
from sim.core.arrays import Vectors
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Share, reduced
from sim.core.scheduling import is_short, workers_for


class LoneCloth:
    """Does what `SelfCollision` does where there can be no pair of elements: one cloth, which does not collide with
    itself.

    Patches are bounded by their boxes, and their motion by the box of their displacements, without turning. That is
    looser than a fitted motion, and found in one pass over the nodes; bodies look at more patches, and touch the same
    nodes.

    Attributes:
        thickness: the largest [m].
        motion: of the patches in the substep, without turns.
        outcome: see `NearCloth`.

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
        self._more = floats()  # `measure_change` writes it, for pairs of patches; nothing reads it here
        self._taken, self.outcome = ti.ndarray(ti.i32, 1), ti.ndarray(ti.i32, 3)
        self.outcome.fill(0)
        self._maxima = LaneReduction(maxima=1, sums=0)
        self._is_short = is_short(patches.vertex_count, NODE_NS)
        self.begin_frame(state)

    def begin_frame(self, state: ClothState) -> None:
        """Margins of contacts are what they are at the start of a run."""
        self.thickness = float(copied(state.thickness).max())
        self._margin.fill(MARGIN * self.thickness)
        self._is_widened = True  # so that what contacts need is compiled in the first substep

    def look(self, state: ClothState) -> None:
        """Note where patches are and how they move in this substep."""
        patches = self._patches
        self._asked = bound_patches.later(
            self._maxima.over(patches.count),
            patches.corner_lists,
            state.position,
            state.displacement,
            self.motion,
            self._is_short,
        )

    def looked(self) -> tuple[float, bool]:
        """The largest displacement [m], or more; and that there is nothing that `find` did not find."""
        return float(self._asked()), True

    def find(self, state: ClothState, contacts: ContactList, recovery: float, *, is_ahead: bool = False) -> None:
        """There is nothing to find."""

    def make_room_for(self, ends: Sequence[int]) -> bool:  # noqa: ARG002  (as `SelfCollision.make_room_for`)
        """There are no lists."""
        return False

    def finish(
        self,
        state: ClothState,
        predicted: ti.Ndarray,
        contacts: ContactList,  # noqa: ARG002  (as `SelfCollision.finish`)
        count: int,  # noqa: ARG002
        *,
        is_changed: bool,
    ) -> Callable[[], Sequence[int]]:
        """As `SelfCollision.finish`: patches that bodies push far may have met others, or a wall."""
        is_asked, self._is_widened = is_changed or self._is_widened, is_changed
        if not is_asked:
            return lambda: (0, 0, 0)
        return end_lone_contacts.later(
            self._patches.corner_lists,
            state.displacement,
            predicted,
            int(is_changed),
            MARGIN * self.thickness,
            self._change,
            self._margin,
            self._more,
            self.outcome,
            is_changed * workers_for(self._patches.count),
            self._taken,
            self._is_short,
        )


@kernel
def bound_patches(
    share: Share,
    corners: PatchNodes,
    position: Vectors,
    displacement: Vectors,
    patches: PatchMotion,
    is_short: ti.template(),
) -> ti.f32:
    """A sphere around each patch, and one around the displacements of its corners; the longest of these, or more."""
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for lane in range(share.tree.lanes):
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
    return reduced(share.tree.partial, share.tree.lanes, 1, 1, share.tree.nodes)[0]
