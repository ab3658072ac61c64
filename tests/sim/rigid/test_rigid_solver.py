"""The rigid solver as the world and a coupling see it: restart, snapshots, starts, meshes."""

import numpy as np
import pytest
import trimesh
from rigid_scenes import GRAVITY, SPACE, advance, ball, body, cube, energy, in_room

from sim.build import build_world
from sim.core.motion import rotation
from sim.core.world import World
from sim.rigid.solver import RigidSolver
from sim.rigid.start import check_start
from sim.scene import SceneParameters


def tumbling_scene() -> SceneParameters:
    """A box and a cylinder fall on a static ball, beside a paddle that turns on a path."""
    paddle = body(
        "paddle",
        {"type": "box", "size": (0.4, 0.05, 0.1)},
        kind="kinematic",
        keyframe=(
            {"time_s": 0.0, "position": (0, 0.1, 0.1)},
            {"time_s": 0.4, "position": (0, 0.2, 0.15), "rotation_deg": (0, 0, 80)},
        ),
    )
    return SceneParameters(
        rigid=(
            paddle,
            body("rock", ball(0.1), (0.05, 0, 0.1), kind="static"),
            body("box", cube(0.1), (0, 0, 0.3), rotation_deg=(20, 30, 10), restitution=0.4),
            body("can", {"type": "cylinder", "radius": 0.05, "height": 0.1}, (0.1, 0.02, 0.4), rotation_deg=(70, 0, 0)),
        )
    )


def build(frames: int = 0) -> World:
    world = build_world(tumbling_scene(), frames_per_second=60)
    for _ in range(frames):
        world.advance_frame()
    return world


def test_continued_run_equals_the_uninterrupted_one_bit_for_bit():
    straight = build(30)
    interrupted = build(19)
    assert interrupted.diagnostics()["rigid"]["contacts"] > 0  # impulses to start from are part of the state
    continued = build()
    continued.restore(19, interrupted.checkpoint())
    for _ in range(11):
        continued.advance_frame()
    expected, found = straight.checkpoint(), continued.checkpoint()
    assert expected.keys() == found.keys()
    for key, array in expected.items():
        np.testing.assert_array_equal(found[key], array, err_msg=key)
    assert straight.diagnostics() == continued.diagnostics()


def test_checkpoint_of_another_scene_is_refused():
    other = in_room(body("alone", ball(0.1), (0, 0, 1)))
    arrays = build().checkpoint()
    with pytest.raises(ValueError, match=r"position must have shape \(1, 3\), got shape \(3, 3\)"):
        other.restore({key.removeprefix("rigid/"): array for key, array in arrays.items()})


def test_world_has_a_snapshot_of_every_body_and_kinematic_ones_follow_their_path():
    world = build(24)
    snapshots = world.snapshots()
    assert set(snapshots) == {"paddle", "rock", "box", "can"}
    assert all(snapshot.kind == "rigid" for snapshot in snapshots.values())
    paddle = snapshots["paddle"].arrays
    np.testing.assert_allclose(paddle["position"], [0, 0.2, 0.15], atol=1e-12)
    half = np.deg2rad(80) / 2
    np.testing.assert_allclose(paddle["orientation"], [np.cos(half), 0, 0, np.sin(half)], atol=1e-12)


def test_snapshot_places_the_rest_mesh_where_the_centre_of_mass_says():
    solver = in_room(
        body("cone", {"type": "cone", "radius": 0.1, "height": 0.4}, (0.1, 0.2, 2), rotation_deg=(30, 40, 50))
    )
    advance(solver, 0.2)
    of_mesh = trimesh.triangles.mass_properties(placed_mesh(solver, "cone").corners)["center_mass"]
    np.testing.assert_allclose(of_mesh, solver.bodies.position[0], atol=1e-12)


def test_samples_and_distances_are_about_the_centre_of_mass():
    solver = in_room(
        body("cone", {"type": "cone", "radius": 0.1, "height": 0.4}, (0.1, 0.2, 2), rotation_deg=(30, 0, 0))
    )
    samples = solver.solids[0].samples(0.02)
    assert samples.dtype == np.float64
    # Samples lie on the facets of the mesh, 160 to the circle: within 0.02 % of the radius inside, in float32.
    np.testing.assert_allclose(solver.solids[0].signed_distance(samples), 0.0, atol=3e-5)
    assert samples[:, 2].min() == pytest.approx(-0.1, abs=1e-4)  # the base is a quarter of the height below
    np.testing.assert_allclose(solver.solids[0].signed_distance(np.array([[0.0, 0.0, 0.35]])), 0.05, atol=1e-4)


def test_ball_of_glued_half_shells_with_a_hole_has_the_mass_of_the_ball_and_rests_on_the_floor(tmp_path):
    shell = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    kept = shell.faces[shell.triangles_center[:, 2] < 0.093]
    path = tmp_path / "shell.ply"
    trimesh.Trimesh(shell.vertices, kept, process=False).export(path)
    solver = in_room(body("shell", {"type": "mesh", "file": str(path)}, (0, 0, 0.2), friction=0.3))
    # The facets of this ball miss 1.1 % of its volume, the flat cap 0.6 %, the integration 0.5 %.
    assert solver.bodies.mass[0] == pytest.approx(500 * 4 / 3 * np.pi * 0.1**3, rel=0.03)
    advance(solver, 0.6)
    # It stands on balls of 2 % of its size under its vertices.
    assert placed_mesh(solver, "shell").vertices[:, 2].min() == pytest.approx(0.0, abs=2e-3)


def placed_mesh(solver, name):
    """The mesh of the only moving body where its snapshot places it."""
    arrays = solver.snapshots()[name].arrays
    mesh = solver.solids[0].solid.rest_mesh()
    return mesh.transformed(1.0, rotation.matrices(arrays["orientation"]), arrays["position"])


@pytest.mark.slow
def test_duck_rocks_on_a_table_without_sinking_or_gaining_energy():
    table = body("table", {"type": "box", "size": (0.2, 0.4, 0.2)}, (0, 0, 0.1), kind="static")
    duck = body("duck", {"type": "duck", "length": 0.2}, (0.06, 0, 0.35), rotation_deg=(20, 30, 0))
    solver = in_room(duck, obstacles=[table])
    energies = []
    for _ in range(16):
        advance(solver, 0.05)
        energies.append(energy(solver))
    # Free flight keeps the energy to rounding; lifting overlaps of some 0.1 mm gives back 1e-4 of it at most.
    assert np.all(np.diff(energies) < 2e-4 * energies[0])
    assert energies[-1] < 0.9 * energies[0]
    vertices = placed_mesh(solver, "duck").vertices
    over_table = np.all(np.abs(vertices[:, :2]) < [0.1, 0.2], axis=1)
    # Contacts stand for the surface within 2 % of the shortest edge, some 2 mm.
    assert vertices[over_table, 2].min() == pytest.approx(0.2, abs=2e-3)


@pytest.mark.parametrize(
    ("bodies", "message"),
    [
        (
            [body("a", cube(0.2), (0, 0, 0.1)), body("b", cube(0.2), (0.15, 0, 0.1))],
            r'rigid bodies "a" and "b" start 0.05 m deep in each other, .* move "b" by \(0.05, 0, 0\) m',
        ),
        (
            [body("a", ball(0.1), (0, 0, 0.1)), body("p", cube(0.2), (0, 0, 0.25), kind="kinematic")],
            'rigid bodies "a" and "p" start 0.05 m deep in each other',
        ),
        ([body("a", cube(0.2), (0, 0, 0.07))], 'rigid body "a" starts 0.03 m behind the wall z- of the domain'),
        ([body("a", cube(0.2), (1.95, 0, 1))], 'rigid body "a" starts 0.05 m behind the wall x+'),
        ([body("a", ball(0.1), (1, 1, 0.47))], r'"a" and "rock" start 0\.03'),
        (  # none of the surface of either is deep in the other
            [body("a", cube(0.2), (0, 0, 0.5)), body("b", cube(0.2), (0, 0, 0.5))],
            r'"a" and "b" start 0.2 m deep in each other, .* move "b" by \(0.2, 0, 0\) m',
        ),
    ],
)
def test_overlapping_starts_are_refused_with_their_depth(bodies, message):
    rock = body("rock", ball(0.2), (1, 1, 0.2), kind="static")
    with pytest.raises(ValueError, match=message):
        check_start(in_room(*bodies, obstacles=[rock]))


def test_touching_bodies_may_start_and_kinematic_ones_may_overlap_static_ones():
    rock = body("rock", ball(0.2), (1, 0, 0.2), kind="static")
    check_start(
        in_room(
            body("a", cube(0.2), (0, 0, 0.1)),
            body("b", cube(0.2), (0.2, 0, 0.1)),
            body("c", cube(0.2), (0.1, 0, 0.3)),
            body("mill", cube(0.2), (1, 0, 0.2), kind="kinematic"),
            obstacles=[rock],
        )
    )


def test_smoke_by_the_name_of_the_moving_bodies_is_refused():
    smoke = {"name": "rigid", "source": [{"shape": ball(0.1)}]}
    with pytest.raises(ValueError, match="name the fluid, smoke or embers otherwise"):
        build_world(SceneParameters(rigid=tumbling_scene().rigid, smoke=(smoke,)), frames_per_second=60)


def test_divergence_names_the_body():
    solver = in_room(body("good", ball(0.1), (0, 0, 1)), body("bad", ball(0.1), (1, 0, 1)))
    solver.bodies.velocity[1, 2] = np.nan
    assert solver.first_bad_quantity() == 'velocity of "bad" is not finite'
    solver.bodies.velocity[1, 2] = 3e4
    assert solver.first_bad_quantity() == 'the speed of "bad" is 3e+04 m/s'


def test_stable_step_shrinks_with_speed_and_spin():
    def step(height=0.012, **motion) -> float:
        return in_room(body("a", ball(0.01), (0, 0, height), **motion)).stable_dt()

    # A quarter of the radius at 100 m/s; a tenth of a radian at 1000 rad/s. Gravity adds a little to the first.
    assert step(velocity=(0, 0, -100)) == pytest.approx(0.25 * 0.01 / 100, rel=1e-3)
    assert step(velocity=(100, 0, 0)) == pytest.approx(2e-3)  # along the floor
    assert step(angular_velocity=(0, 0, 1000)) == pytest.approx(1e-4)
    assert step() == pytest.approx(2e-3)
    # Its box has a radius of 17 mm; half of the way from there to the floor.
    assert step(0.1, velocity=(0, 0, -100)) == pytest.approx(0.5 * (0.1 - 0.01 * 3**0.5) / 100, rel=1e-3)


@pytest.mark.parametrize(
    "target",
    [
        {"kind": "static", "shape": cube(0.02)},
        {"kind": "static", "shape": {"type": "box", "size": (0.02, 2.0, 2.0)}},
        {"kind": "dynamic", "shape": cube(0.02), "density": 1e6},
        {"kind": "dynamic", "shape": ball(0.01), "density": 1e6, "velocity": (-150.0, 0.0, 0.0)},
    ],
)
def test_a_bullet_takes_large_steps_on_its_way_and_hits_what_it_meets(target):
    """At 150 m/s a quarter of its radius is passed in 8 microseconds: 1,600 steps of the way of 2 m."""
    bullet = body("bullet", ball(0.005), (-1.0, 0.0, 0.0), velocity=(150.0, 0.0, 0.0))
    other = body("target", target["shape"], (1.0, 0.0, 0.0), **{k: v for k, v in target.items() if k != "shape"})
    is_static = target["kind"] == "static"
    bodies, obstacles = ([bullet], [other]) if is_static else ([bullet, other], [])
    solver = RigidSolver(bodies, obstacles=obstacles, domain=SPACE, gravity=(0, 0, 0))
    assert advance(solver, 0.006) < 100
    assert (solver.bodies.velocity[0, 0], solver.bodies.position[0, 0]) == (150.0, pytest.approx(-0.1))
    assert advance(solver, 0.009) < 150
    assert solver.bodies.velocity[0, 0] < 1.0  # it neither passed nor missed
    assert solver.bodies.position[0, 0] < 1.0


def test_bodies_that_are_led_are_where_their_paths_say_whatever_the_step():
    moved = body("a", cube(0.2), (0, 0, 1), kind="kinematic", velocity=(1, 0, 0), angular_velocity=(0, 0, 1))
    solver = in_room(moved)
    assert solver.stable_dt() == pytest.approx(0.1)  # a tenth of a radian; no stack of boxes hangs on it
    solver.substep(0.1)
    np.testing.assert_allclose(solver.bodies.position, [[0.1, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(rotation.matrices(solver.bodies.orientation[0])[:2, 0], [np.cos(0.1), np.sin(0.1)])
    np.testing.assert_allclose(solver.bodies.velocity, [[1, 0, 0]], atol=1e-12)
    with_another = in_room(moved, body("b", ball(0.1), (0, 0, 3)))
    assert with_another.stable_dt() == pytest.approx(2e-3)
    path = [{"time_s": 1.0, "position": (0, 0, 1)}, {"time_s": 2.0, "position": (1, 0, 1)}]
    sets_in = body("c", cube(0.2), kind="kinematic", keyframe=path)
    assert in_room(sets_in).stable_dt() == pytest.approx(2e-3)


def test_loaded_ball_rocks_with_the_period_of_theory():
    """omega² = m g e / (I + m (R - e)²) for a ball that rolls, its centre of mass e below the middle."""
    radius, share = 0.1, 0.5
    weight = 500.0 * 4 / 3 * np.pi * radius**3
    ballast = ({"mass": share * weight, "position": (0.0, 0.0, -0.06)},)
    tilt = 5.0
    shape = ball(radius)
    solver = in_room(body("b", shape, (0, 0, radius), ballast=ballast, rotation_deg=(0, tilt, 0), friction=1.0))
    properties = solver.solids[0].mass_properties(500.0)
    below = -properties.centre_of_mass[2]
    about_contact = properties.inertia[1, 1] + properties.mass * (radius - below) ** 2
    period = 2 * np.pi / np.sqrt(properties.mass * GRAVITY * below / about_contact)
    dt, turns = period / 400, []
    for _ in range(900):
        solver.substep(dt)
        turns.append(rotation.matrices(solver.bodies.orientation[0])[0, 2])
    rises = [k for k in range(1, len(turns)) if turns[k - 1] < 0.0 <= turns[k]]
    # 1 %: a swing of 5 degrees takes 0.05 % longer than a small one, and the contact is solved to a step in time.
    assert (rises[1] - rises[0]) * dt == pytest.approx(period, rel=0.01)
