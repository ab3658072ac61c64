"""Bodies of several shapes, and bodies that break: exact masses, stresses that formulas give, momenta that stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from rigid_scenes import SPACE, advance, ball, body, cube, in_room, in_space, totals

from sim.rigid.groups import with_groups
from sim.rigid.joint_parameters import JointParameters, joint_problems
from sim.rigid.joint_points import JointPoints
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.solver import RigidSolver
from sim.rigid.start import start_problems
from sim.shapes.body_geometry import BodyGeometry

LENGTH, EDGE, DENSITY = 1.0, 0.1, 2000.0
MODULUS = EDGE**3 / 6.0
"""Of a section of a beam [m³]: bending moment over stress."""


def compound(*parts: dict) -> dict:
    return {"type": "compound", "part": tuple(parts)}


def beam(count: int, *, strength: float, impact_s: float = 1.0e-3, **keys) -> list[RigidBodyParameters]:
    """A beam along x of so many glued boxes."""
    box = {"type": "box", "size": (LENGTH / count, EDGE, EDGE)}
    middles = (np.arange(count) + 0.5) * LENGTH / count - 0.5 * LENGTH
    shape = compound(*({"shape": box, "position": (float(x), 0.0, 0.0)} for x in middles))
    breaks = {"strength": strength, "impact_s": impact_s}
    return list(with_groups((body("beam", shape, density=DENSITY, friction=0.0, breaks=breaks, **keys),)))


def knife(x: float) -> RigidBodyParameters:
    return body("knife", {"type": "box", "size": (0.002, EDGE, 0.2)}, (x, 0.0, 0.1), kind="static", friction=0.0)


def broken(solver: RigidSolver) -> list[int]:
    assert solver.glue is not None
    return np.flatnonzero(solver.glue.is_broken).tolist()


# --- bodies of several shapes ---


def test_a_compound_weighs_what_its_parts_do():
    head, handle, rho = np.array([0.1, 0.03, 0.04]), np.array([0.02, 0.02, 0.3]), (7800.0, 700.0)
    at = np.array([[0.01, 0.0, 0.2], [0.0, 0.0, 0.03]])
    parts = [
        {"shape": {"type": "box", "size": tuple(edges)}, "position": tuple(place), "density": density}
        for edges, place, density in zip((head, handle), at, rho, strict=True)
    ]
    found = BodyGeometry(body("hammer", compound(*parts))).mass_properties(500.0)
    mass = np.array([np.prod(head) * rho[0], np.prod(handle) * rho[1]])
    centre = mass @ at / mass.sum()
    inertia = np.zeros((3, 3))
    for edges, weight, arm in zip((head, handle), mass, at - centre, strict=True):
        inertia += weight / 12.0 * (edges @ edges * np.eye(3) - np.diag(edges**2))
        inertia += weight * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    assert found.mass == pytest.approx(mass.sum(), rel=1e-12)
    assert found.centre_of_mass == pytest.approx(centre, rel=1e-12, abs=1e-15)
    assert found.inertia == pytest.approx(inertia, rel=1e-10, abs=1e-15)


def test_round_parts_have_exact_volumes_and_overlaps_are_told_of():
    rod = {"shape": {"type": "cylinder", "radius": 0.01, "height": 0.2}}
    apart = BodyGeometry(body("dumbbell", compound(rod, {"shape": ball(0.03), "position": (0.0, 0.0, 0.13)}))).solid
    assert apart.volume == pytest.approx(np.pi * 1e-4 * 0.2 + 4.0 / 3.0 * np.pi * 0.03**3, rel=1e-12)
    assert not apart.warnings
    inside = BodyGeometry(body("dumbbell", compound(rod, {"shape": ball(0.03), "position": (0.0, 0.0, 0.1)}))).solid
    assert "overlap" in inside.warnings[0]


def test_a_compound_is_hollow_where_its_parts_leave_room():
    """A bridge over a post rests on it with its deck: its hull would lie on the post long before."""
    deck = {"shape": {"type": "box", "size": (0.3, 0.1, 0.04)}, "position": (0.0, 0.0, 0.12)}
    legs = [{"shape": {"type": "box", "size": (0.04, 0.1, 0.1)}, "position": (x, 0.0, 0.05)} for x in (-0.13, 0.13)]
    post = body("post", {"type": "box", "size": (0.18, 0.08, 0.2)}, (0.0, 0.0, 0.1), kind="static")
    bridge = body("bridge", compound(deck, *legs), (0.0, 0.0, 0.11))
    solver = in_room(bridge, obstacles=[post])
    assert not start_problems(solver)
    advance(solver, 0.6)
    assert float(solver.view("bridge")["position"][2]) == pytest.approx(0.1, abs=2e-5)


def test_compounds_that_a_joint_holds_do_not_touch_each_other():
    box = {"shape": {"type": "box", "size": (0.1, 0.1, 0.1)}}
    pair = compound(box, {**box, "position": (0.15, 0.0, 0.0)})
    bodies = body("first", pair, (0.0, 0.0, 1.0)), body("second", pair, (0.05, 0.0, 1.0))
    hinge = JointParameters(name="axle", kind="hinge", between=("first", "second"), anchor=(0, 0, 1), axis=(0, 1, 0))
    apart = RigidSolver(bodies, domain=SPACE, gravity=(0.0, 0.0, 0.0))
    assert start_problems(apart)
    joined = RigidSolver(bodies, joints=[hinge], domain=SPACE, gravity=(0.0, 0.0, 0.0))
    assert not start_problems(joined)
    advance(joined, 0.02)
    assert joined.diagnostics()["contacts"] == 0.0


# --- pieces ---


@pytest.mark.parametrize("shape", [cube(0.2), {"type": "torus", "major_radius": 0.1, "minor_radius": 0.03}])
def test_pieces_fill_their_whole_and_do_not_overlap(shape):
    def pieces(seed: int) -> list[RigidBodyParameters]:
        return list(with_groups((body("pot", shape, breaks={"strength": 1e6, "pieces": 20, "seed": seed}),)))

    whole, made = BodyGeometry(body("pot", shape)).solid, pieces(3)
    geometries = [BodyGeometry(each) for each in made]
    volumes = np.array([each.solid.volume for each in geometries])
    assert [each.name for each in made] == [f"pot_{number}" for number in range(1, 21)]
    assert volumes.sum() == pytest.approx(whole.rest_mesh().signed_volume, rel=1e-12)
    assert volumes.min() > 0.1 * volumes.mean()
    again = [BodyGeometry(each).solid.volume for each in pieces(4)]
    assert not np.allclose(volumes, again)
    assert not start_problems(in_space(*made))
    mass = sum(each.mass_properties(500.0).mass for each in geometries)
    assert mass == pytest.approx(500.0 * whole.rest_mesh().signed_volume, rel=1e-12)


def test_a_body_that_holds_flies_as_one_of_one_piece():
    spin = {"angular_velocity": (3.0, 0.2, 1.0), "velocity": (0.3, 0.0, 0.1)}
    shape = {"type": "box", "size": (LENGTH, EDGE, EDGE)}
    whole, glued = in_space(body("beam", shape, density=DENSITY, **spin)), in_space(*beam(5, strength=1e12, **spin))
    for solver in (whole, glued):
        advance(solver, 1.0, 2e-3)
    middle = glued.view("beam_3")
    for name, values in whole.view("beam").items():
        assert np.abs(middle[name] - values).max() < 1e-9, name
    assert glued.diagnostics()["kinetic_energy"] == pytest.approx(whole.diagnostics()["kinetic_energy"], rel=1e-9)


# --- stresses ---


@pytest.mark.parametrize(("share", "breaks"), [(0.98, True), (1.02, False)])
def test_a_beam_breaks_under_its_weight_where_and_when_beam_theory_says(share, breaks):
    """On two supports M = g rho A (L s - L²/2) / 4 in the middle, s being their distance; within 2 %."""
    weight = DENSITY * 9.81 * EDGE * EDGE * LENGTH
    half_span = 0.499
    stress = weight * (0.5 * half_span - LENGTH / 8.0) / MODULUS
    supports = [knife(x).model_copy(update={"name": f"knife{x:g}"}) for x in (-half_span, half_span)]
    solver = in_room(*beam(10, strength=share * stress, position=(0.0, 0.0, 0.25)), obstacles=supports)
    advance(solver, 0.04)
    assert broken(solver) == ([4] if breaks else [])


@pytest.mark.parametrize("dt", [2e-3, 7e-4])
@pytest.mark.parametrize(("share", "breaks"), [(1.03, True), (0.97, False)])
def test_a_beam_that_falls_across_a_knife_breaks_from_one_speed_on(share, breaks, dt):
    """F = m v / impact_s on its middle third: F L / 18 and F / 3 at the faces beside; within 3 %, at any step."""
    impact_s, strength = 2e-3, 4e6
    bending, shear = LENGTH / 18.0 / MODULUS, 1.0 / (3.0 * EDGE * EDGE)
    force = strength / (0.5 * bending + np.sqrt(0.25 * bending**2 + shear**2))
    speed = share * force * impact_s / (DENSITY * LENGTH * EDGE * EDGE)
    falling = beam(3, strength=strength, impact_s=impact_s, position=(0.0, 0.0, 0.2587), velocity=(0.0, 0.0, -speed))
    solver = RigidSolver(falling, obstacles=[knife(0.0)], domain=SPACE, gravity=(0.0, 0.0, 0.0))
    advance(solver, 0.02 / speed, dt)
    assert broken(solver) == ([0, 1] if breaks else [])


def wall(*, offset: float, strength: float, **keys) -> list[RigidBodyParameters]:
    """A wall of 5 x 4 glued bricks, every other row by so much to one side."""
    box = {"type": "box", "size": (0.05, 0.1, 0.08)}
    places = [(0.0, 0.1 * column + row % 2 * offset, 0.08 * (row + 0.5)) for row in range(4) for column in range(5)]
    shape = compound(*({"shape": box, "position": place} for place in places))
    return list(with_groups((body("wall", shape, density=1800.0, breaks={"strength": strength}, **keys),)))


@pytest.mark.parametrize(("offset", "share"), [(0.0, 0.001), (0.04, 0.3)])
@pytest.mark.parametrize("dt", [2e-3, 8e-4])
def test_a_wall_that_stands_on_the_floor_breaks_nowhere(offset, share, dt):
    """In columns nothing pulls, and rho g h presses at the foot; in bond the ends overhang by two fifths of a brick.

    A solver of contacts may have nearly all weight on two corners, which pulls with five times that.
    """
    solver = in_room(*wall(offset=offset, strength=share * 1800.0 * 9.81 * 0.32))
    advance(solver, 2.0, dt)
    assert broken(solver) == []
    assert solver.bodies.is_asleep.all()


@pytest.mark.parametrize("dt", [5e-4, 1e-4])
@pytest.mark.parametrize(("share", "breaks"), [(1.05, True), (0.95, False)])
def test_what_lands_slowly_on_a_knife_breaks_by_the_time_of_the_blow_however_short_steps_are(share, breaks, dt):
    """F = m v / impact_s, as of a fast one; the impulse over the step would be ten times that."""
    impact_s, speed = 1e-3, 0.08
    bending, shear = LENGTH / 18.0 / MODULUS, 1.0 / (3.0 * EDGE * EDGE)
    force = DENSITY * LENGTH * EDGE * EDGE * speed / impact_s
    strength = force * (0.5 * bending + np.sqrt(0.25 * bending**2 + shear**2)) / share
    falling = beam(3, strength=strength, impact_s=impact_s, position=(0.0, 0.0, 0.25), velocity=(0.0, 0.0, -speed))
    solver = RigidSolver(falling, obstacles=[knife(0.0)], domain=SPACE, gravity=(0.0, 0.0, 0.0))
    advance(solver, 0.02, dt)
    assert broken(solver) == ([0, 1] if breaks else [])


@pytest.mark.parametrize(("share", "breaks"), [(1.01, True), (0.99, False)])
def test_what_spins_bursts_at_its_speed_and_keeps_its_momenta(share, breaks):
    """A rod about its middle: rho omega² L² / 8."""
    strength = 1.0e5
    omega = share * np.sqrt(8.0 * strength / (DENSITY * LENGTH**2))
    solver = in_space(*beam(4, strength=strength, angular_velocity=(0.0, 0.0, omega), velocity=(0.1, 0.2, -0.3)))
    before = totals(solver, "momentum"), totals(solver, "angular_momentum")
    energy = solver.diagnostics()["kinetic_energy"]
    advance(solver, 0.05)
    assert (1 in broken(solver)) == breaks
    after = totals(solver, "momentum"), totals(solver, "angular_momentum")
    for one, two in zip(before, after, strict=True):
        assert np.abs(two - one).max() < 1e-12 * np.abs(one).max()
    assert solver.diagnostics()["kinetic_energy"] == pytest.approx(energy, rel=1e-9)


def test_a_blow_that_breaks_keeps_momentum_and_adds_no_energy():
    breaks = {"strength": 3e4, "pieces": 12, "seed": 2}
    shot = body("shot", ball(0.04), (-0.4, 0.02, 1.0), density=7800.0, velocity=(6.0, 0.0, 0.0))
    (*pieces,) = with_groups((body("block", cube(0.2), (0.0, 0.0, 1.0), density=2000.0, breaks=breaks),))
    solver = in_space(shot, *pieces)
    before, turning = totals(solver, "momentum"), totals(solver, "angular_momentum")
    energy = solver.diagnostics()["kinetic_energy"]
    while not broken(solver) and solver.time_s < 0.1:
        advance(solver, 0.002)
    assert len(set(solver.glue.leader.tolist())) > 3
    assert np.abs(totals(solver, "momentum") - before).max() < 1e-12 * np.abs(before).max()
    assert np.abs(totals(solver, "angular_momentum") - turning).max() < 1e-12 * np.abs(turning).max()
    advance(solver, 0.05)
    assert np.abs(totals(solver, "momentum") - before).max() < 1e-12 * np.abs(before).max()
    # Moving overlapping pieces apart turns them without a moment.
    assert np.abs(totals(solver, "angular_momentum") - turning).max() < 1e-5 * np.abs(turning).max()
    assert solver.diagnostics()["kinetic_energy"] < energy


def test_pieces_come_to_rest_and_sleep():
    breaks = {"strength": 2e4, "pieces": 8, "seed": 1}
    (*pieces,) = with_groups((body("block", cube(0.1), (0.0, 0.0, 0.6), density=2000.0, breaks=breaks),))
    solver = in_room(*pieces)
    advance(solver, 3.0)
    assert len(set(solver.glue.leader.tolist())) > 1
    assert solver.bodies.is_asleep.all()
    assert solver.diagnostics()["max_penetration"] < 1e-4


def test_what_wakes_a_piece_wakes_all_that_it_is_glued_to():
    block = beam(4, strength=1e12, position=(0.0, 0.0, 0.5 * EDGE))
    shot = body("shot", ball(0.05), (1.2, 0.0, 0.05), density=7800.0, velocity=(-0.001, 0.0, 0.0))
    solver = in_room(*block, shot)
    advance(solver, 0.8)
    assert solver.bodies.is_asleep[:4].all()
    push = np.array([-2.0, 0.0, 0.0])
    solver.push("shot", push)
    advance(solver, 0.5)
    assert not solver.bodies.is_asleep[:4].any()
    velocities = solver.bodies.velocity[:4]
    assert velocities[0, 0] < -0.05
    assert np.abs(velocities - velocities[0]).max() < 1e-3


def test_a_restart_breaks_on_with_the_same_bits():
    def scene() -> RigidSolver:
        breaks = {"strength": 5e4, "pieces": 10, "seed": 5}
        (*pieces,) = with_groups(
            (body("pot", cube(0.1), (0.0, 0.0, 0.3), rotation_deg=(20.0, 30.0, 0.0), density=2000.0, breaks=breaks),)
        )
        return in_room(*pieces)

    straight = scene()
    advance(straight, 0.21, 1e-3)
    continued = scene()
    continued.restore(straight.checkpoint())
    for solver in (straight, continued):
        advance(solver, 0.15, 1e-3)
    assert len(broken(straight)) > 2
    expected, found = straight.checkpoint(), continued.checkpoint()
    for name, array in expected.items():
        np.testing.assert_array_equal(array, found[name], err_msg=name)


# --- what is refused ---


@pytest.mark.parametrize(
    ("keys", "path"),
    [
        ({"kind": "static", "breaks": {"strength": 1e6, "pieces": 4}}, ("breaks",)),
        ({"density": 500.0, "breaks": {"strength": 1e6}}, ("breaks", "pieces")),
        (
            {
                "density": 500.0,
                "breaks": {"strength": 1e6, "pieces": 4},
                "ballast": ({"mass": 1.0, "position": (0, 0, 0)},),
            },
            ("ballast",),
        ),
    ],
)
def test_what_cannot_break_is_refused(keys, path):
    with pytest.raises(ValidationError) as refused:
        RigidBodyParameters(name="pot", shape=cube(0.1), **{"kind": "dynamic", **keys})
    assert refused.value.errors()[0]["ctx"]["error"].path == path


def test_joints_do_not_go_with_what_breaks():
    pieces = with_groups((body("pot", cube(0.1), breaks={"strength": 1e6, "pieces": 2}),))
    joint = JointParameters(name="nail", kind="ball", between=("pot_1",), anchor=(0.0, 0.0, 0.0))
    (problem,) = joint_problems([joint], pieces)
    assert "pot_1" in problem.text


def test_loads_that_cannot_be_shared_are_as_the_contacts_have_them_and_are_counted(monkeypatch):
    def does_not_end(*_arguments, **_keywords):
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr("sim.rigid.supports.nnls", does_not_end)
    solver = in_room(*beam(4, strength=1.0, position=(0.0, 0.0, 0.5 * EDGE)))
    advance(solver, 0.05)
    told = solver.diagnostics()
    assert told["loads_not_shared"] > 0.0
    assert told["faces_broken"] > 0.0


# --- what is not glued, beside what is ---


def beside_a_beam(is_there: bool, *others: RigidBodyParameters, **keys) -> RigidSolver:
    """Bodies in free space, with one that breaks far away, or without it; they are the last."""
    far = beam(2, strength=1e9, position=(0.0, 0.0, 3.0)) if is_there else []
    return RigidSolver([*far, *others], domain=SPACE, **{"gravity": (0.0, 0.0, 0.0), **keys})


def joint_of(**keys) -> JointParameters:
    return JointParameters.model_validate({"name": "joint", **keys})


@pytest.mark.parametrize("kind", ["spring", "ball"])
def test_joints_move_a_body_alike_beside_one_that_could_break(kind):
    anchors = ((1.3, -1.0, 1.2), (1.0, -1.0, 1.2))
    spring = {"anchors": anchors, "stiffness": 50.0, "length": 0.2}
    joint = joint_of(kind=kind, between=("link",), **(spring if kind == "spring" else {"anchor": anchors[1]}))
    found = []
    for is_there in (False, True):
        solver = beside_a_beam(is_there, body("link", cube(EDGE), anchors[0]), joints=[joint], gravity=(0, 0, -9.81))
        for _ in range(300):
            solver.substep(1e-3)
        found.append([solver.bodies.position[-1], solver.bodies.velocity[-1]])
    assert np.allclose(found[0], found[1], rtol=0.0, atol=1e-9)


def test_a_step_that_joints_halve_pushes_each_body_once(monkeypatch):
    link = body("link", cube(0.05), (1.0, -1.0, 1.0))
    joint = joint_of(kind="ball", between=("link",), anchor=(1.0, -1.0, 1.2))
    solver = beside_a_beam(True, body("free", cube(EDGE), (0, 1, 3)), link, joints=[joint], gravity=(0, 0, -9.81))
    hold, calls = solver.joints.hold, []

    def too_long_at_first(*args, **keys):
        calls.append(1)
        return replace(hold(*args, **keys), is_too_long=len(calls) == 1)

    monkeypatch.setattr(solver.joints, "hold", too_long_at_first)
    solver.substep(2e-3)
    assert len(calls) == 3
    assert solver.bodies.velocity[:3, 2] == pytest.approx(-9.81 * 2e-3, rel=1e-9)


def test_a_body_that_gets_heavier_beside_one_that_could_break_keeps_its_momentum():
    hits = body("hits", cube(EDGE), (0.0, 1.0, 1.0), velocity=(1.0, 0.0, 0.0))
    solver = beside_a_beam(True, hits, body("is_hit", cube(EDGE), (0.11, 1.0, 1.0)))
    solver.scale_mass("hits", 10.0)
    before = totals(solver, "momentum")
    for _ in range(30):
        solver.substep(1e-3)
    assert solver.bodies.velocity[-1, 0] > 0.5
    assert totals(solver, "momentum") == pytest.approx(before, abs=1e-9)


@pytest.mark.parametrize("happens", ["breaks", "groups"])
def test_points_of_cloth_are_pushed_once_in_a_step(happens, monkeypatch):
    """Also where something breaks in it, and where bodies take other numbers of steps."""
    points = JointPoints(np.full((1, 2), -1), np.array([[-1.0, -1.0, 1.0]]), np.zeros((1, 3)), np.array([0.1]))
    joint = joint_of(kind="ball", between=("link",), anchor=(1.0, -1.0, 1.2))
    fast = body("fast", ball(0.05), (0.0, 0.0, 2.0), velocity=(14.0, 0.0, 0.0))
    others = (fast, body("in_its_way", cube(EDGE), (0.13, 0.0, 2.0)), body("link", cube(0.05), (1.2, -1.0, 1.2)))
    solver = beside_a_beam(True, *others, joints=[joint], points=points, gravity=(0, 0, -9.81))
    points.acceleration[:] = (0.0, 0.0, -9.81)
    dt = solver.stable_dt()
    if happens == "breaks":
        found, overloaded = iter([np.array([0])]), solver.glue.overloaded
        monkeypatch.setattr(
            solver.glue, "overloaded", lambda *args: (overloaded(*args), next(found, np.zeros(0, dtype=int)))[1]
        )
    else:
        solver.bodies.velocity[2] = (42.0, 0.0, 0.0)
    solver.substep(dt)
    assert broken(solver) == ([0] if happens == "breaks" else [])
    assert points.velocity[0, 2] == pytest.approx(-9.81 * dt, rel=1e-9)


def test_bodies_sleep_beside_one_that_could_break_though_something_pushes():
    slab = beam(2, strength=1e9, position=(0.0, 0.0, 0.5 * EDGE))
    solver = in_room(*slab, body("cube", cube(EDGE), (0.0, 0.5, 0.5 * EDGE), density=DENSITY))
    nothing = np.zeros((3, 3))
    for _ in range(400):
        solver.apply_impulses(nothing, nothing)
        solver.substep(2e-3)
    assert solver.bodies.is_asleep.all()


def test_what_flies_out_of_sight_as_pieces_stops_for_good():
    lost = beam(2, strength=1e12, position=(0.0, 0.0, 3.0), velocity=(3000.0, 0.0, 0.0))
    solver = RigidSolver([*lost, body("near", cube(EDGE), (0, 1, 1))], domain=SPACE, gravity=(0, 0, -1e-3))
    for _ in range(60):
        solver.substep(1e-3)
    assert solver.bodies.is_lost.tolist() == [True, True, False]
    assert not solver.bodies.velocity[:2].any()


def test_bodies_that_are_led_are_where_others_see_them_beside_what_could_break():
    way = [{"time_s": 0.0, "position": (0.0, 1.0, 1.0)}, {"time_s": 1.0, "position": (1.0, 1.0, 1.0)}]
    solver = beside_a_beam(True, body("led", cube(EDGE), way[0]["position"], kind="kinematic", keyframe=way))
    for _ in range(3):
        solver.substep(0.01)
    assert np.array_equal(solver.glue.movers.position[-1], solver.bodies.position[-1])
