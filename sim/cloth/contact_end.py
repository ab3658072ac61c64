"""The end of a substep's contacts in one launch: whether pairs may have crossed, and what of the lists is used up."""

import taichi as ti

from sim.cloth.bundles import (
    Contacts,
    Counters,
    MovingPatches,
    PatchPairArrays,
    SubstepEnd,
    TestedContacts,
    TrackedNodes,
)
from sim.cloth.crossing_repair import repair_crossing
from sim.cloth.patch_motion_kernels import (
    PAIRS_AT_A_TIME,
    PATCHES_AT_A_TIME,
    finish_pair,
    finish_patch,
    measure_change,
)
from sim.core.arrays import Vectors
from sim.core.launch import large_kernel
from sim.core.scheduling import begin_sharing, next_item


@large_kernel
def end_contacts(
    count: ti.i32,
    contacts: Contacts,
    tested: TestedContacts,
    vertex_count: ti.i32,
    nodes: TrackedNodes,
    predicted: Vectors,
    patches: MovingPatches,
    end: SubstepEnd,
    met: PatchPairArrays,
    workers: ti.math.ivec3,
    counters: Counters,
) -> ti.math.ivec3:
    """Test `count` contacts (`repair_crossing`); if none failed, measure how far they displaced patches; if not farther
    than allowed for, displacements are final: note where they lead, and what of the lists they use up.

    Args:
        count, contacts, tested: see `repair_crossing`.
        vertex_count, nodes: the vertices.
        predicted: displacements as contacts were looked for [m].
        patches, end, met: see `finish_patch` and `finish_pair`.
        workers: see `sim.core.scheduling`; for patches that contacts may have displaced, all, and their pairs.
        counters: three numbers.

    Returns how many pairs failed; whether patches were displaced farther than allowed for; and whether any displacement
    is not finite.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    contacts_end, vertices_end, displaced_end, patches_end, pairs_end = (
        count,
        vertex_count,
        workers[0],
        workers[1],
        workers[2],
    )
    counters.found[0], counters.found[1], counters.found[2] = 0, 0, 0
    for c in range(contacts_end):
        repair_crossing(
            c,
            contacts,
            tested.impulse,
            nodes.position,
            nodes.displacement,
            tested.inverse_mass,
            tested.thickness,
            tested.crossing,
            counters.found,
        )
    begin_sharing(counters.taken, 0)
    for worker in range(displaced_end):
        stop = ti.select(counters.found[0] == 0, patches.corners.count, 0)
        m = next_item(-1, worker, counters.taken, 0, PATCHES_AT_A_TIME)
        while m < stop:
            measure_change(
                m,
                patches.corners,
                nodes.displacement,
                predicted,
                end.half_thickness,
                patches.budget.change,
                patches.budget.margin,
                patches.budget.more,
                counters.found,
            )
            m = next_item(m, worker, counters.taken, 0, PATCHES_AT_A_TIME)
    for i in range(vertices_end):
        if counters.found[0] + counters.found[1] + counters.found[2] == 0:
            nodes.expected[i] = nodes.position[i] + nodes.displacement[i]
    begin_sharing(counters.taken, 1)
    for worker in range(patches_end):
        stop = ti.select(counters.found[0] + counters.found[1] + counters.found[2] == 0, patches.corners.count, 0)
        m = next_item(-1, worker, counters.taken, 1, PATCHES_AT_A_TIME)
        while m < stop:
            finish_patch(m, nodes, patches, end)
            m = next_item(m, worker, counters.taken, 1, PATCHES_AT_A_TIME)
    begin_sharing(counters.taken, 2)
    for worker in range(pairs_end):
        stop = ti.select(counters.found[0] + counters.found[1] + counters.found[2] == 0, met.count, 0)
        p = next_item(-1, worker, counters.taken, 2, PAIRS_AT_A_TIME)
        while p < stop:
            finish_pair(p, met, patches, end.negligible)
            p = next_item(p, worker, counters.taken, 2, PAIRS_AT_A_TIME)
    return ti.math.ivec3(counters.found[0], counters.found[1], counters.found[2])
