"""Cloth against cloth: nothing crosses, momentum is kept, layers stay apart; and the checker that says so."""

import numpy as np
import pytest
from cloth_scenes import SOFT, WEIGHTLESS, cloth, rectangle, solver_of
from contact_scenes import (
    SPACE,
    cloth_of,
    contacts_of,
    displace,
    find,
    listed_pairs,
    point_triangle_distances,
    segment_distances,
    world_of,
)
from thread_counts import digest_of, result_on_any_threads

from sim.cloth import continuous_contacts
from sim.cloth.contacts import EDGE_EDGE
from sim.cloth.continuous_contacts import ContinuousContacts
from sim.cloth.parameters import DEFAULT_SUBSTEPS
from sim.cloth.self_collision import SelfCollision
from validation.crossing_triangles import crossings, edges_of_triangles

pytestmark = pytest.mark.usefixtures("taichi_cpu")

TRIANGLE = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]


# --- the checker ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("other", "count"),
    [
        ([(0.2, 0.2, -1.0), (0.2, 0.2, 1.0), (3.0, 3.0, 1.0)], 2),  # an edge through the face, and the other way round
        ([(0.2, 0.2, 1e-9), (0.2, 0.2, 1.0), (3.0, 3.0, 1.0)], 0),  # a billionth above it
        ([(0.2, 0.2, 0.0), (0.2, 0.2, 1.0), (0.3, 0.3, 1.0)], 2),  # a corner of two edges that touches it
        ([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)], 0),  # parallel
    ],
)
def test_checker_counts_edges_through_triangles(other, count):
    assert len(crossings(np.array([*TRIANGLE, *other]), np.array([[0, 1, 2], [3, 4, 5]]))) == count


def test_checker_sees_triangles_with_a_common_corner_cross():
    points = np.array([*TRIANGLE, (1.0, 1.0, 0.5), (1.0, 1.0, -0.5)])
    assert len(crossings(points, np.array([[0, 1, 2], [0, 3, 4]]))) == 1
    flat = np.array([*TRIANGLE, (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
    assert len(crossings(flat, np.array([[0, 1, 2], [0, 3, 4]]))) == 0


# --- pairs ----------------------------------------------------------------------------------------------------------


def test_search_lists_all_pairs_within_reach_once_and_no_others():
    solver = solver_of(cloth(shape=rectangle((0.2, 0.2), (7, 7)), thickness=0.02), gravity=WEIGHTLESS)
    state = solver.state
    x = np.random.default_rng(1).uniform(-0.06, 0.06, (49, 3))  # crumpled beyond recognition: cells hold many
    state.set_positions(x)
    state.displacement.from_numpy(
        np.repeat([[[0.0, 0.0, 2e-3], [0.0, 0.0, -2e-3]]], 25, axis=0).reshape(50, 3)[:49].astype(np.float32)
    )
    pairs = SelfCollision(state)
    pairs.look()
    find(pairs)
    found, found_edges = listed_pairs(pairs)
    # A pair of patches is searched as far as its own motion asks for, to a thickness at least.
    reach = pairs.met.reach.to_numpy()[: pairs.met.count].max()
    assert reach < 0.1
    triangles = state.host.triangles
    vertex, triangle = (each.ravel() for each in np.mgrid[0:49, 0 : len(triangles)])
    apart = (triangles[triangle] != vertex[:, None]).all(axis=1)
    vertex, corners = vertex[apart], triangles[triangle[apart]]
    distance = point_triangle_distances(x[vertex], *np.moveaxis(x[corners], 1, 0))
    _expect_listed(found, np.concatenate([vertex[:, None], corners], axis=1), distance, 0.02, reach)

    edges = edges_of_triangles(triangles)
    first, second = np.triu_indices(len(edges), k=1)
    apart = ~(edges[first][:, :, None] == edges[second][:, None, :]).any(axis=(1, 2))
    both = np.concatenate([edges[first[apart]], edges[second[apart]]], axis=1)
    _expect_listed(found_edges, both, segment_distances(*np.moveaxis(x[both], 1, 0)), 0.02, reach)


def _expect_listed(found, candidates, distance, radius, reach):
    assert 0 < np.count_nonzero(distance < radius) < np.count_nonzero(distance < reach) < len(distance)
    listed = set(found)
    assert len(listed) == len(found)
    # Edges are listed from that with the smaller first end on; float32 cannot tell at the rim.
    expected = {tuple(row) for row in candidates[distance < radius - 1e-6].tolist()}
    unwanted = {tuple(row) for row in candidates[distance > reach + 1e-6].tolist()}
    assert expected <= listed
    assert not unwanted & listed


# --- the guarantee --------------------------------------------------------------------------------------------------


def crumpled(count, contacts=True):
    solver = solver_of(cloth(shape=rectangle((0.3, 0.3), (count, count)), thickness=5e-3), gravity=WEIGHTLESS)
    if contacts:
        solver.contacts = ContinuousContacts(solver.state)
    return solver


def test_violent_displacements_never_make_cloth_cross_itself_and_keep_momentum():
    """Every node is thrown by a third of an edge at random, ten times: without contacts all triangles cross."""
    count = 9
    held, free = crumpled(count), crumpled(count, contacts=False)
    generator = np.random.default_rng(0)
    mass = held.state.mass.to_numpy().astype(np.float64)[:, None]
    for _ in range(10):
        thrown = generator.normal(0.0, 0.33 * 0.3 / (count - 1), (count**2, 3)).astype(np.float32)
        displace(free, thrown)
        change = mass * (displace(held, thrown) - thrown)
        assert len(crossings(held.state.positions(), held.state.host.triangles)) == 0
        # Sums of integers are exact; what is left is the rounding of float32, 6e-8 of each change.
        assert np.abs(change.sum(axis=0)).max() < 1e-6 * np.abs(change).sum()
    assert len(crossings(free.state.positions(), free.state.host.triangles)) > 100


def test_the_plane_of_a_pair_is_between_both_however_near_they_are():
    """Two edges of 2 cm that are 4 micrometres apart, as silk in a heap: across their shortest way, as far as float32
    knows it, half of such planes cut one of them, and nothing tells when they cross.
    """
    sheet = {"shape": rectangle((0.02, 0.02), (2, 2)), "thickness": 2e-4}
    world = world_of({**sheet, "position": (0.0, 0.0, 0.1)}, sheet, domain=SPACE, gravity=WEIGHTLESS)
    state = cloth_of(world).state
    generator = np.random.default_rng(2)
    for _ in range(20):
        (p, a), n = generator.normal(size=(2, 3)), generator.normal(size=3)
        n /= np.linalg.norm(n)
        p, a = (0.01 * v / np.linalg.norm(v) for v in (p - (p @ n) * n, a - (a @ n) * n))
        upper, lower = [-0.9 * p, 1.1 * p], [-1.05 * a, 0.95 * a]
        ends = [*upper, *(v + 0.02 * n for v in upper), *lower, *(v - 0.02 * n for v in lower)]
        state.set_positions(np.array(ends) + np.repeat([[4e-6], [0.0]], 4, axis=0) * n + (0.4, -0.3, 0.2))
        state.displacement.fill(0.0)
        pairs = SelfCollision(state)
        pairs.look()
        contacts = find(pairs)
        count = contacts.found.counter.to_numpy()[0]
        vertices, kinds, normals = (
            each.to_numpy()[:count] for each in (contacts.found.vertices, contacts.found.kind, contacts.found.normal)
        )
        met = [k for k in range(count) if kinds[k] == EDGE_EDGE and set(vertices[k]) == {0, 1, 4, 5}]
        assert len(met) == 1
        along = state.positions()[vertices[met[0]]] @ normals[met[0]].astype(np.float64)
        assert along[:2].min() - along[2:].max() > 3e-6


def test_layers_do_not_pass_through_each_other_however_fast():
    """A sheet that covers twenty thicknesses in one substep, on to another one."""
    sheet = {"shape": rectangle((0.2, 0.2), (7, 7)), "thickness": 2e-3}
    world = world_of(
        {**sheet, "position": (0.003, 0.005, 0.03)},
        {**sheet, "rotation_deg": (0, 0, 20)},
        domain=SPACE,
        gravity=WEIGHTLESS,
    )
    solver = cloth_of(world)
    thrown = np.zeros((98, 3))
    thrown[:49, 2] = -0.04
    displace(solver, thrown)
    positions = solver.state.positions()
    assert len(crossings(positions, solver.state.host.triangles)) == 0
    assert positions[:49, 2].min() > positions[49:, 2].max()


def test_layers_at_rest_share_their_weight_in_the_short_steps_of_explicit_springs():
    """Impulses of a layer's weight over 10 us, an angstrom per step, are far above the unit that they are summed in."""
    keys = {"integrator": "explicit", "thickness": 0.5e-3, "shape": rectangle((0.2, 0.2), (21, 21))}
    solver = solver_of(
        cloth("lower", **keys), cloth("upper", position=(4e-3, 3e-3, 0.5e-3), **keys), gravity=WEIGHTLESS
    )
    dt = solver.stable_dt()
    assert dt < 1.1e-5
    solver.contacts = ContinuousContacts(solver.state)
    mass = solver.state.mass.to_numpy().astype(np.float64)[:, None]
    thrown = np.zeros((882, 3), dtype=np.float32)
    thrown[441:, 2] = -9.81 * dt**2
    change = mass * (displace(solver, thrown, dt) - thrown)
    # One layer falls by a weight on the other, which is as heavy: each gets half of it. What overlaps is all but 1 %.
    assert np.abs(change).sum() == pytest.approx(mass[441:].sum() * 9.81 * dt**2, rel=0.02)
    # Each contact rounds four times to half a unit, a millionth of the weight of a node.
    assert np.abs(change.sum(axis=0)).max() < 4e-6 * np.abs(change).sum()


def test_thin_layers_do_not_feel_that_a_thicker_cloth_is_in_the_scene():
    sheet = {"shape": rectangle((0.1, 0.1), (6, 6)), "thickness": 0.2e-3}
    layers = [{**sheet, "position": (0.003, 0.002, 0.3e-3)}, sheet]
    thick = {**sheet, "thickness": 15e-3, "position": (0.5, 0.0, 0.0)}
    thrown = np.zeros((72, 3))
    thrown[:36, 2] = -0.4e-3
    allowed = []
    for cloths in (layers, [*layers, thick]):
        solver = cloth_of(world_of(*cloths, domain=SPACE, gravity=WEIGHTLESS))
        padded = np.concatenate([thrown, np.zeros((36 * (len(cloths) - 2), 3))])
        allowed.append(displace(solver, padded)[:72])
        assert contacts_of(solver).diagnostics()["repaired_crossings"] == 0
    # The iteration is longer where the thick cloth touches itself; contacts of thin cloth may miss so much of theirs.
    np.testing.assert_allclose(allowed[1], allowed[0], atol=0.02 * 0.2e-3)


def test_impact_zones_hold_what_contacts_cannot():
    """Nodes that are driven against each other so hard that contact iterations do not suffice still do not cross."""
    solver = crumpled(9)
    generator = np.random.default_rng(3)
    zones = 0.0
    for _ in range(12):
        displace(solver, generator.normal(0.0, 0.1, (81, 3)))
        zones += contacts_of(solver).diagnostics()["impact_zone_vertices"]
        assert len(crossings(solver.state.positions(), solver.state.host.triangles)) == 0
    assert zones > 0


def test_cloth_that_a_gale_presses_into_a_heap_on_the_floor_is_told_as_jammed():
    """Nearly all of it is in impact zones in every substep of so few; in the same fall without wind a few nodes are in
    some.
    """
    gale = {"air_density": 1.2, "wind": (0.0, 0.0, -40.0)}
    told = []
    for air in (gale, {}):
        world = world_of(
            {
                "material": "silk",
                "shape": rectangle((0.5, 0.5), (11, 11)),
                "position": (0.0, 0.0, 0.3),
                "rotation_deg": (85.0, 7.0, 0.0),
                "velocity": (0.0, 0.0, -10.0),
                "substeps": DEFAULT_SUBSTEPS,
                **air,
            }
        )
        for _ in range(8):
            world.advance_frame()
        numbers = contacts_of(cloth_of(world)).diagnostics()
        assert numbers["contacts"] > 0
        told.append(numbers["jammed"])
    assert told == [1, 0]


# --- thickness ------------------------------------------------------------------------------------------------------


def test_pressed_layers_stay_a_thickness_apart():
    """Two sheets on the floor under twenty times their weight."""
    thickness = 4e-3
    sheets = [
        {
            **SOFT,
            "shape": rectangle((0.12, 0.12), (7, 7)),
            "thickness": thickness,
            "position": (0.002 * k, 0.001 * k, 0.003 + 0.006 * k),
            "rotation_deg": (0, 0, 17 * k),
        }
        for k in range(2)
    ]
    world = world_of(*sheets, gravity=(0.0, 0.0, -200.0))
    for _ in range(15):
        world.advance_frame()
    solver = cloth_of(world)
    state = solver.state
    x, triangles = state.positions(), state.host.triangles
    assert len(crossings(x, triangles)) == 0
    lower, upper = (np.flatnonzero(state.host.body == number) for number in (0, 1))
    inner = upper[np.abs(x[upper, :2]).max(axis=1) < 0.04]
    corners = np.moveaxis(x[triangles[np.isin(triangles[:, 0], lower)]], 1, 0)
    distance = point_triangle_distances(x[inner][:, None], *(each[None] for each in corners)).min(axis=1)
    # Contacts are inelastic constraints, not springs: what is missing is what some iterations leave of a load that
    # comes anew in each substep, g dt² = 0.14 mm or 3.5 % of the thickness, and 5 % that the iteration tolerates.
    assert distance.min() > 0.85 * thickness
    assert distance.max() < 1.1 * thickness
    # The floor carries both: twice the load, on contacts of half the distance.
    assert x[lower, 2].min() > 0.65 * 0.5 * thickness


def test_folded_cloth_may_lie_nearer_than_its_thickness_to_its_own_neighbours():
    """Thickness above the node spacing must not blow a flat sheet up: neighbours keep their distance at rest."""
    world = world_of({"shape": rectangle((0.1, 0.1), (11, 11)), "thickness": 0.015}, domain=SPACE, gravity=WEIGHTLESS)
    start = cloth_of(world).state.positions()
    world.advance_frame()
    assert np.abs(cloth_of(world).state.positions() - start).max() < 1e-6


def test_cloth_that_is_not_to_collide_with_itself_crosses_itself_but_no_other():
    sheet = {"shape": rectangle((0.2, 0.2), (7, 7)), "thickness": 2e-3, "self_collision": False}
    world = world_of(sheet, {**sheet, "position": (0.0, 0.0, 0.1)}, domain=SPACE, gravity=WEIGHTLESS)
    solver = cloth_of(world)
    generator = np.random.default_rng(2)
    for _ in range(6):
        displace(solver, generator.normal(0.0, 0.02, (98, 3)))
    crossing = solver.state.host.body[crossings(solver.state.positions(), solver.state.host.triangles)]
    assert len(crossing) > 0
    assert (crossing == crossing[:, :1]).all()


def test_crossings_that_pins_force_are_counted_when_they_happen():
    """One needle goes down and one goes up through the same triangle of a net, of which only the middle is free."""
    edges = [{"edge": edge} for edge in ("x-", "x+", "y-", "y+")]
    net = {**SOFT, "shape": rectangle((0.2, 0.2), (3, 3)), "thickness": 2e-3, "pin": edges}

    def needle(x: float, side: int) -> dict[str, object]:
        way = [{"time_s": 0.0}, {"time_s": 0.1, "offset": (0.0, 0.0, -0.1 * side)}]
        return {
            **SOFT,
            "shape": rectangle((0.02, 0.02), (2, 2)),
            "thickness": 2e-3,
            "position": (x, 0.02, 0.03 * side),
            "pin": [{"corner": "x-y-", "keyframe": way, "interpolation": "linear"}],
        }

    world = world_of(net, needle(0.03, 1), needle(0.06, -1), domain=SPACE, gravity=WEIGHTLESS)
    solver = cloth_of(world)

    def counted_and_true() -> tuple[float, int]:
        world.advance_frame()
        counted = contacts_of(solver).diagnostics()["crossings_left"]
        return counted, len(crossings(solver.state.positions(), solver.state.host.triangles))

    # At 1 m/s the needles reach the net, 0.03 m away, after 1.8 frames.
    assert counted_and_true() == (0, 0)
    counted, true = counted_and_true()
    assert counted > 0
    assert true > 0


# --- drops ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "counts", "frames", "highest"),
    [
        ((0.2, 0.3), (11, 16), 30, 0.1),
        pytest.param((1.0, 1.0), (41, 41), 70, 0.35, marks=pytest.mark.nightly),
    ],
    ids=["small", "large"],
)
def test_a_sheet_that_falls_on_its_edge_and_folds_does_not_cross_itself(size, counts, frames, highest):
    fallen = {"position": (0.0, 0.0, 0.5 * size[1] + 0.05), "rotation_deg": (85.0, 7.0, 0.0)}
    world = world_of({"shape": rectangle(size, counts), "thickness": 3e-3, **fallen})
    solver = cloth_of(world)
    contacts = 0.0
    for frame in range(frames):
        world.advance_frame()
        numbers = contacts_of(solver).diagnostics()
        contacts = max(contacts, numbers["contacts"])
        assert numbers["crossings_left"] == 0
        if frame % 5 == 4 or frame == frames - 1:
            assert len(crossings(solver.state.positions(), solver.state.host.triangles)) == 0
    assert contacts > 0.5 * solver.state.vertex_count
    assert solver.state.positions()[:, 2].max() < highest
    # Half a thickness above the floor; a few substeps may press it nearer.
    assert solver.state.positions()[:, 2].min() > 0.0


# --- the same bits --------------------------------------------------------------------------------------------------


FALL = {
    "shape": rectangle((0.15, 0.15), (9, 9)),
    "thickness": 3e-3,
    "position": (0.0, 0.0, 0.06),
    "rotation_deg": (70.0, 5.0, 0.0),
}


def test_rounds_that_begin_before_contacts_are_counted_change_nothing(monkeypatch):
    """As on a GPU, which does not wait for the host: lists that do not hold, or have no room, are seen later."""
    waiting, ahead = world_of(FALL), world_of(FALL)
    searches = []
    for world in (waiting, ahead):
        monkeypatch.setattr(continuous_contacts, "runs_on_gpu", lambda world=world: world is ahead)
        contacts = contacts_of(cloth_of(world))
        weigh, begun = contacts._weigh, []
        contacts._weigh = lambda weigh=weigh, begun=begun, **k: begun.append(k["is_first"]) or weigh(**k)
        for _ in range(12):
            world.advance_frame()
        searches.append(sum(begun))
    assert searches[1] > searches[0] > 0  # some began for nothing
    for name, array in waiting.checkpoint().items():
        np.testing.assert_array_equal(ahead.checkpoint()[name], array, err_msg=name)


def test_contacts_do_not_depend_on_when_pairs_were_searched_for():
    listed, anew = world_of(FALL), world_of(FALL)
    pairs = contacts_of(cloth_of(anew))._pairs
    look = pairs.look

    def look_anew():
        pairs.forget()
        return look()

    pairs.look = look_anew
    for _ in range(12):
        listed.advance_frame()
        anew.advance_frame()
    assert contacts_of(cloth_of(listed)).diagnostics()["contacts"] > 0.0
    for name, array in listed.checkpoint().items():
        np.testing.assert_array_equal(anew.checkpoint()[name], array, err_msg=name)


@pytest.mark.parametrize("self_collision", [True, False])
def test_a_run_with_contacts_continues_bit_for_bit(self_collision):
    through, resumed = (world_of({**FALL, "self_collision": self_collision}) for _ in range(2))
    for _ in range(10):
        through.advance_frame()
    saved = {name: array.copy() for name, array in through.checkpoint().items()}
    for _ in range(4):
        through.advance_frame()
    resumed.restore(10, saved)
    for _ in range(4):
        resumed.advance_frame()
    for name, array in through.checkpoint().items():
        np.testing.assert_array_equal(resumed.checkpoint()[name], array, err_msg=name)
    assert cloth_of(resumed).diagnostics() == cloth_of(through).diagnostics()


def digests_of_falls() -> list[tuple[str, float]]:
    """Checkpoint and contacts of a sheet that a ball hits, with contacts of cloth and with those of the ball alone."""
    sheet = {"shape": rectangle((0.2, 0.2), (11, 11)), "thickness": 4e-3, "rotation_deg": (60.0, 5.0, 0.0)}
    ball = {"kind": "dynamic", "density": 300.0, "shape": {"type": "sphere", "radius": 0.04}}
    ball |= {"position": (0.0, 0.0, 0.3), "velocity": (0.0, 0.0, -2.0)}
    found = []
    for self_collision in (True, False):
        world = world_of({**sheet, "position": (0.0, 0.0, 0.12), "self_collision": self_collision}, bodies=[ball])
        for _ in range(10):
            world.advance_frame()
        found.append((digest_of(world.checkpoint()), contacts_of(cloth_of(world)).diagnostics()["contacts"]))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, pytest.param(5, marks=pytest.mark.nightly)])
def test_contacts_do_not_depend_on_the_number_of_threads(threads):
    with_itself, with_the_ball = result_on_any_threads(digests_of_falls, threads=threads)
    assert min(with_itself[1], with_the_ball[1]) > 0.0


def test_what_contacts_do_in_every_substep_is_foreseen():
    """A sheet that wind presses on the floor is pushed back as far each time: nothing has to be looked at twice."""
    world = world_of({"wind": (0.0, 0.0, -30.0), "air_density": 1.2, "position": (0.0, 0.0, 0.01)})
    contacts = contacts_of(cloth_of(world))
    rounds, find = [], contacts._find
    contacts._find = lambda *arguments: rounds.append(find(*arguments)) or rounds[-1]
    for _ in range(8):
        rounds.clear()
        steps = world.advance_frame().substeps["cloth"]
    assert rounds[0][0] > 0
    assert len(rounds) <= steps + 1  # margins are forgotten from frame to frame
