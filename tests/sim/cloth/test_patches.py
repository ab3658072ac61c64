"""Patches of cloth: they share its elements out, and their fitted motion bounds how much nearer these come."""

from itertools import pairwise

import numpy as np
import pytest
import taichi as ti
from cloth_scenes import WEIGHTLESS, cloth, rectangle, solver_of
from contact_scenes import find, listed_pairs, listed_places

from sim.cloth.contacts import ContactList
from sim.cloth.near_pairs import UNKNOWN
from sim.cloth.self_collision import TRIANGLES_PER_PATCH, Patches, SelfCollision

pytestmark = pytest.mark.usefixtures("taichi_cpu")


def state_of(count: int, size: float = 0.3):
    return solver_of(cloth(shape=rectangle((size, size), (count, count))), gravity=WEIGHTLESS).state


def pieces(values, first):
    bounds = first.to_numpy()
    return [values.to_numpy()[a:b] for a, b in pairwise(bounds)]


def test_patches_share_out_every_element_once_and_know_all_corners():
    solver = solver_of(
        cloth("large", shape=rectangle((0.3, 0.2), (13, 9))),
        cloth("small", shape=rectangle((0.1, 0.1), (2, 2)), position=(0.0, 0.0, 1.0)),
        gravity=WEIGHTLESS,
    )
    host = solver.state.host
    patches = Patches(host)
    lists, corners = patches.lists, pieces(patches.corners.nodes, patches.corners.first)
    triangles, edges = pieces(lists.triangles, lists.first_triangle), pieces(lists.edges, lists.first_edge)
    vertices = pieces(lists.vertices.nodes, lists.vertices.first)
    assert len(triangles) == patches.count > 2
    assert max(len(each) for each in triangles) <= TRIANGLES_PER_PATCH
    for parts, whole in ((triangles, host.triangles), (edges, host.edges.nodes)):
        assert sorted(map(tuple, np.concatenate(parts).tolist())) == sorted(map(tuple, whole.tolist()))
    assert sorted(np.concatenate(vertices).tolist()) == list(range(117 + 4))
    cloth_of_patch = patches.cloth.to_numpy()
    for number, corner in enumerate(corners):
        assert set(triangles[number].ravel()) == set(corner.tolist())
        assert set(edges[number].ravel()) | set(vertices[number]) <= set(corner.tolist())
        assert (host.body[corner] == cloth_of_patch[number]).all()


def test_patches_of_very_uneven_meshes_have_like_numbers_of_triangles():
    """Widths of the strips grow by a thousand; a grid of cells as wide as the widest would hold all the rest in one."""
    state = state_of(33)
    state.host.position[:, 0] = np.repeat(np.geomspace(1e-3, 1.0, 33)[None, :], 33, axis=0).ravel()
    sizes = np.diff(Patches(state.host).lists.first_triangle.to_numpy())
    assert sizes.max() <= TRIANGLES_PER_PATCH
    assert sizes.min() >= TRIANGLES_PER_PATCH // 2


def approaches(state, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """How much nearer pairs of patches come at most [m], by their motion; the pairs; the corners of the patches."""
    state.displacement.from_numpy(displacement.astype(np.float32))
    pairs = SelfCollision(state)
    pairs.thickness = pairs.mean_edge = 1.0
    pairs.look()
    find(pairs)
    met, patches = pairs.met, pairs.patches
    # All are searched: none are so far apart that they might sleep.
    assert pairs.expired_count == met.count
    assert met.count == patches.count * (patches.count + 1) // 2
    return met.approach.to_numpy()[: met.count], met.pairs.to_numpy()[: met.count], corners_of(pairs)


def test_fitted_motion_bounds_how_much_nearer_points_of_patches_come():
    state = state_of(13)
    generator = np.random.default_rng(0)
    x = state.host.position + generator.normal(0.0, 0.003, (169, 3))
    state.set_positions(x)
    displacement = generator.normal(0.0, 5e-4, (169, 3))
    displacement[:, 2] += 0.02 * np.sin(20.0 * x[:, 0])  # neighbours move alike, others against each other
    bound, pairs, corners = approaches(state, displacement)
    for approach, (first, second) in zip(bound, pairs, strict=True):
        before = x[corners[first]][:, None] - x[corners[second]][None]
        change = displacement[corners[first]][:, None] - displacement[corners[second]][None]
        nearer = np.linalg.norm(before, axis=2) - np.linalg.norm(before + change, axis=2)
        assert nearer.max() <= approach
    # It is not the trivial bound, twice the largest motion, but of the motion that is not rigid: within patches of
    # seven centimetres a wave of thirty bends by 0.02 (20 x 0.035)² / 2 = 5 mm, and the noise is up to 2 mm.
    alone = pairs[:, 0] == pairs[:, 1]
    assert bound[alone].max() < 2.0 * 0.007 + 0.004


def test_cloth_that_moves_as_a_rigid_body_comes_no_nearer_to_itself():
    state = state_of(13)
    x = state.host.position
    displacement = np.cross([0.01, 0.02, -0.03], x - (1.0, 2.0, 0.0))
    bound, _, _ = approaches(state, displacement)
    # The fit is regularized by 1e-5 of the inertia, so that turns of 0.037 are up to 2e-5 of that off: 0.3 m apart,
    # 2e-7 m, where points move by 0.07 m.
    assert bound.max() < 5e-7


def test_a_cloth_of_one_patch_meets_itself():
    bound, pairs, _ = approaches(state_of(3), np.zeros((9, 3)))
    assert pairs.tolist() == [[0, 0]]
    assert bound.tolist() == [0.0]


def finish(pairs: SelfCollision, predicted: ti.Ndarray | None = None) -> list[int]:
    """A substep is over, with displacements that contacts changed from those `predicted`."""
    is_changed, displacement = predicted is not None, pairs._state.displacement
    return pairs.finish(predicted or displacement, ContactList(1), 0, is_changed=is_changed)()


def crumple(pairs: SelfCollision, count: int) -> None:
    """Some substeps of a flat sheet whose nodes wander."""
    state = pairs._state
    generator, x = np.random.default_rng(2), state.host.position.copy()
    for _ in range(count):
        step = generator.uniform(-2e-3, 2e-3, x.shape)
        state.set_positions(x)
        state.displacement.from_numpy(step.astype(np.float32))
        pairs.look()
        find(pairs)
        finish(pairs)
        x += step


def test_frames_that_follow_each_other_search_only_what_has_moved():
    """Lists hold across frames: of a sheet at rest nothing is searched twice."""
    state = state_of(13)
    pairs = SelfCollision(state)
    for expected in (True, False, False):
        pairs.begin_frame()
        pairs.look()
        find(pairs)
        finish(pairs)
        assert (pairs.searches > 0.0) == expected


def test_cloth_that_is_put_elsewhere_is_searched_anew():
    """As a run is that a checkpoint takes back: displacements say nothing of that motion."""
    state = state_of(13)
    pairs, anew = SelfCollision(state), SelfCollision(state)
    crumple(pairs, 3)
    x = np.random.default_rng(3).uniform(-0.06, 0.06, state.host.position.shape)
    state.set_positions(x)
    pairs.begin_frame()
    for each in (pairs, anew):
        each.look()
        find(each)
    assert min(len(each) for each in listed_pairs(anew)) > 100
    assert listed_pairs(pairs) == listed_pairs(anew)


def test_changed_thickness_is_searched_anew():
    state = state_of(13)
    pairs = SelfCollision(state)
    crumple(pairs, 1)
    state.thickness.fill(0.03)  # beyond the spacing of 25 mm: now neighbours are listed
    pairs.begin_frame()
    pairs.look()
    find(pairs)
    anew = SelfCollision(state)
    anew.look()
    find(anew)
    assert pairs.thickness == anew.thickness == np.float32(0.03)
    assert min(len(each) for each in listed_pairs(anew)) > 100
    assert listed_pairs(pairs) == listed_pairs(anew)


def test_pairs_keep_a_changed_thickness_where_a_thicker_cloth_changes_nothing():
    """Two sheets of 1 mm lie on each other and become 4 mm thick; a third, of 8 mm, hangs elsewhere."""
    sheet = rectangle((0.3, 0.3), (13, 13))
    solver = solver_of(
        cloth("lower", shape=sheet, thickness=0.001),
        cloth("upper", shape=sheet, thickness=0.001, position=(0.0, 0.0, 0.0011)),
        cloth("thick", shape=sheet, thickness=0.008, position=(0.0, 0.0, 1.0)),
        gravity=WEIGHTLESS,
    )
    state, pairs = solver.state, SelfCollision(solver.state)
    for name in ("lower", "upper"):
        pairs.begin_frame()
        pairs.look()
        find(pairs)
        solver.change(name, thickness=0.004)
    pairs.begin_frame()
    pairs.look()
    find(pairs)
    assert pairs.thickness == np.float32(0.008)
    listed = pairs.listed.on_device
    for are_edges in (False, True):
        places = listed_places(pairs, are_edges)
        vertices, wanted = listed.pairs.to_numpy()[places], listed.wanted.to_numpy()[places]
        body = state.host.body[vertices]
        # What pairs keep is asked for when they are near: these are 1.1 mm apart, and a spacing or so aside.
        across = (wanted != UNKNOWN) & (body[:, 0] != body[:, 2])
        assert np.count_nonzero(across) > 100
        np.testing.assert_allclose(wanted[across], 0.004, rtol=1e-6)


def test_one_wild_vertex_has_only_its_own_surroundings_watched():
    """A vertex that contacts push by 2 cm in a substep, in the corner of a sheet at rest of a metre."""
    state = state_of(45, size=1.0)
    thickness = float(state.thickness.to_numpy().max())
    pairs, predicted = SelfCollision(state), ti.Vector.ndarray(3, ti.f32, 45 * 45)
    predicted.fill(0.0)
    pairs.look()
    find(pairs)
    displacement = np.zeros((45 * 45, 3), dtype=np.float32)
    displacement[0, 2] = 0.02
    state.displacement.from_numpy(displacement)
    assert finish(pairs, predicted) == [0, 1, 0]
    pairs.look()
    find(pairs)
    allowed = pairs.met.allowed.to_numpy()[: pairs.met.count]
    both = pairs.met.pairs.to_numpy()[: pairs.met.count]
    of_wild = np.isin(both, [m for m, corners in enumerate(corners_of(pairs)) if 0 in corners]).any(axis=1)
    assert 0 < np.count_nonzero(of_wild) < len(both) / 20
    np.testing.assert_allclose(allowed[~of_wild & (allowed > 0.0)], thickness, rtol=1e-6)
    # Half as much again as what it was, and of the other patch half a thickness, or likewise.
    assert allowed[of_wild].max() >= 0.03


def corners_of(pairs: SelfCollision) -> list[np.ndarray]:
    return pieces(pairs.patches.corners.nodes, pairs.patches.corners.first)


def test_lists_that_grow_keep_what_they_had_and_need_no_search_more():
    state = state_of(13)
    roomy, tight = SelfCollision(state), SelfCollision(state)
    for pairs, capacity in ((roomy, 10**5), (tight, 1)):
        pairs.listed.resize(capacity)
        crumple(pairs, 40)
    assert min(len(each) for each in listed_pairs(tight)) > 100
    assert listed_pairs(tight) == listed_pairs(roomy)
    assert tight.searches == roomy.searches


def test_patches_that_are_paired_anew_keep_the_lists_they_had():
    """A sheet that wanders as far as its pairs of patches were listed for, but not apart; its corner is folded over."""
    state = state_of(33, size=1.0)
    pairs, anew = SelfCollision(state), SelfCollision(state)
    x = state.host.position.copy()
    x[(x[:, :2] > 0.3).all(axis=1), 2] += 0.004
    step, meetings, searched = np.zeros(x.shape), 0, []
    generator = np.random.default_rng(4)
    for _ in range(40):
        step[:, 2] = generator.uniform(-4e-4, 4e-4, len(x)) + 4e-3 * np.sin(40.0 * x[:, 0])
        state.set_positions(x)
        state.displacement.from_numpy(step.astype(np.float32))
        before = pairs.met.count, pairs.searches
        pairs.look()
        pairs.looked()
        is_met, known = (
            pairs._is_outrun and before[0] > 0,
            pairs.met.slack.to_numpy()[: before[0]] > 0.0,
        )
        find(pairs)
        if is_met:
            meetings += 1
            carried = pairs.carried.to_numpy()[: pairs.met.count]
            assert np.isin(np.flatnonzero(known), carried).mean() > 0.9
            searched.append(pairs.searches - before[1])
            # And what they list is what is there, and what is not near is not missed.
            anew.forget()
            anew.look()
            find(anew)
            assert near_pairs(pairs) == near_pairs(anew)
        finish(pairs)
        x += step
    assert meetings >= 2
    assert max(searched) < 0.5 * anew.searches / meetings


def near_pairs(pairs: SelfCollision) -> list[tuple[int, ...]]:
    """What is found in the lists, in an order of its own."""
    contacts = find(pairs)
    return sorted(map(tuple, contacts.found.vertices.to_numpy()[: contacts.found.counter.to_numpy()[0]].tolist()))


def test_patches_are_searched_anew_only_where_cloth_moves():
    """One corner of a sheet is folded to and fro, thirty times: lists of the rest hold."""
    state = state_of(33, size=1.0)
    pairs = SelfCollision(state)
    x = state.host.position
    at_corner = (x[:, :2] > 0.3).all(axis=1)
    displacement = np.zeros((33 * 33, 3), dtype=np.float32)
    pairs.look()
    find(pairs)
    once = pairs.searches
    generator, height = np.random.default_rng(1), np.zeros(33 * 33)
    for _ in range(30):
        target = np.where(at_corner, generator.uniform(-5e-3, 5e-3, 33 * 33), 0.0)
        displacement[:, 2] = target - height
        state.displacement.from_numpy(displacement)
        pairs.look()
        find(pairs)
        finish(pairs)
        height = target
        state.set_positions(x + height[:, None] * (0.0, 0.0, 1.0))
    # The corner is a thirtieth of the sheet, and its patches and those beside them are less than a fifth.
    assert once < pairs.searches < once + 30.0 * once / 5.0
