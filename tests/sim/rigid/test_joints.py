"""Joints: what they hold, limit, drive and pull, against equations of motion."""

import itertools
import math

import numpy as np
import pytest
from rigid_scenes import GRAVITY, ROOM, SPACE, advance, ball, body, cube, energy, totals
from scipy.integrate import solve_ivp
from thread_counts import digest_of, result_on_any_threads

from sim.rigid.joint_parameters import JointParameters
from sim.rigid.solver import RigidSolver

DENSITY = 500.0
BAR = (0.5, 0.04, 0.04)
MASS = DENSITY * math.prod(BAR)
Y = (0.0, 1.0, 0.0)


def joint(name: str, kind: str, between, **more) -> JointParameters:
    return JointParameters(name=name, kind=kind, between=between, **more)


def scene(*bodies, joints, gravity=(0.0, 0.0, -GRAVITY), obstacles=()) -> RigidSolver:
    return RigidSolver(bodies, joints=joints, obstacles=obstacles, domain=SPACE, gravity=gravity)


def bar(name: str, x: float, z: float = 2.0, **more):
    """A bar along x with its middle at x [m]."""
    return body(name, {"type": "box", "size": BAR}, (x, 0.0, z), **more)


def angles(solver: RigidSolver) -> np.ndarray:
    """By which bars have turned about y [rad], (n,)."""
    turned = solver.bodies.rotation()
    return np.arctan2(-turned[:, 2, 0], turned[:, 0, 0])


def gap(solver: RigidSolver) -> float:
    return solver.diagnostics()["joint_gap"]


def double_pendulum() -> RigidSolver:
    joints = [
        joint("first", "hinge", ("a",), anchor=(0, 0, 2), axis=Y),
        joint("second", "hinge", ("b", "a"), anchor=(0.5, 0, 2), axis=Y),
    ]
    return scene(bar("a", 0.25), bar("b", 0.75), joints=joints)


def exact_double_pendulum(duration_s: float) -> np.ndarray:
    """Angles of two bars that fall from the level [rad], by Lagrange's equations, to 1e-12."""
    length, moment = BAR[0], MASS * (BAR[0] ** 2 + BAR[2] ** 2) / 12.0

    def rates(_, state):
        a, b, w, v = state
        link = 0.5 * MASS * length**2
        cosine, sine = math.cos(a - b), math.sin(a - b)
        matrix = [[moment + 1.25 * MASS * length**2, link * cosine], [link * cosine, moment + 0.25 * MASS * length**2]]
        weight = MASS * GRAVITY * length
        right = [-link * sine * v**2 + 1.5 * weight * math.cos(a), link * sine * w**2 + 0.5 * weight * math.cos(b)]
        return [w, v, *np.linalg.solve(matrix, right)]

    return solve_ivp(rates, (0.0, duration_s), np.zeros(4), rtol=1e-12, atol=1e-12).y[:2, -1]


def test_a_double_pendulum_follows_its_equations_to_second_order():
    exact, errors = exact_double_pendulum(0.8), []
    for dt in (4e-3, 2e-3):
        solver = double_pendulum()
        start = energy(solver)
        deviations = []
        for _ in range(round(0.8 / dt)):
            solver.substep(dt)
            deviations.append(abs(energy(solver) - start))
        errors.append(np.abs(np.angle(np.exp(1j * (angles(solver) - exact)))).max())
        # The energy that it falls through is 0.5 m g L for each bar.
        assert max(deviations) < 2e-3 * (dt / 2e-3) ** 2 * MASS * GRAVITY * BAR[0]
        assert gap(solver) < 1e-9
    assert errors[1] < 5e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_a_slider_crank_moves_its_piston_as_geometry_says():
    crank, rod, speed = 0.1, 0.3, 10.0
    bodies = [
        body("crank", {"type": "box", "size": (crank, 0.02, 0.02)}, (0.5 * crank, 0, 1)),
        body("rod", {"type": "box", "size": (rod, 0.02, 0.02)}, (crank + 0.5 * rod, 0, 1)),
        body("piston", cube(0.05), (crank + rod, 0, 1)),
    ]
    joints = [
        joint("shaft", "hinge", ("crank",), anchor=(0, 0, 1), axis=Y, motor={"speed": speed, "max_torque": 1e3}),
        joint("pin", "hinge", ("rod", "crank"), anchor=(crank, 0, 1), axis=Y),
        joint("gudgeon", "hinge", ("rod", "piston"), anchor=(crank + rod, 0, 1), axis=Y),
        joint("guide", "slider", ("piston",), axis=(1, 0, 0)),
    ]
    solver = scene(*bodies, joints=joints)  # 20 rows, 17 of them independent
    solver.bodies.angular_velocity[0, 1] = speed
    dt, worst = 1e-3, 0.0
    for step in range(630):
        solver.substep(dt)
        angle = speed * (step + 1) * dt
        exact = crank * math.cos(angle) + math.sqrt(rod**2 - (crank * math.sin(angle)) ** 2)
        worst = max(worst, abs(solver.bodies.position[2, 0] - exact))
    assert worst < 1e-6  # of 0.2 m; the first step, in which rod and piston get going, is half a step late
    assert solver.diagnostics()["joints_apart"] == 0.0
    assert gap(solver) < 1e-9


def test_a_motor_turns_as_fast_as_its_torque_allows_and_then_at_its_speed():
    wheel = body("wheel", {"type": "cylinder", "radius": 0.2, "height": 0.1}, (0, 0, 1))
    moment = 0.5 * DENSITY * math.pi * 0.2**2 * 0.1 * 0.2**2
    axle = joint("axle", "hinge", ("wheel",), anchor=(0, 0, 1), axis=(0, 0, 1), motor={"speed": 0.6, "max_torque": 0.1})
    solver = scene(wheel, joints=[axle])
    advance(solver, 0.5, 2e-3)
    turned = 0.5 * 0.1 / moment * 0.5**2
    assert solver.bodies.angular_velocity[0, 2] == pytest.approx(0.1 / moment * 0.5, rel=1e-3)  # the moment by balls
    assert 2.0 * math.asin(solver.bodies.orientation[0, 3]) == pytest.approx(turned, rel=1e-3)
    advance(solver, 0.3, 2e-3)
    assert solver.bodies.angular_velocity[0] == pytest.approx([0, 0, 0.6], abs=1e-9)


def test_a_motor_goes_where_it_is_sent_and_holds_against_gravity():
    servo = {"angle_deg": -60.0, "max_torque": 20.0}
    solver = scene(bar("arm", 0.25), joints=[joint("h", "hinge", ("arm",), anchor=(0, 0, 2), axis=Y, motor=servo)])
    advance(solver, 0.8, 2e-3)
    # The way falls to 1/e in 0.1 s.
    assert math.degrees(angles(solver)[0]) == pytest.approx(-60.0 * (1 - math.exp(-8.0)), abs=0.1)


def test_a_position_is_reached_by_a_slider_no_faster_than_its_force_allows():
    mass = DENSITY * 0.1**3
    motor = {"position": 1.0, "max_force": 2.0 * mass, "response_s": 0.3}
    solver = scene(
        body("cart", cube(0.1), (0, 0, 1)), joints=[joint("s", "slider", ("cart",), axis=(1, 0, 0), motor=motor)]
    )
    advance(solver, 0.3, 2e-3)
    assert solver.bodies.position[0, 0] == pytest.approx(0.5 * 2.0 * 0.3**2, rel=1e-3)
    advance(solver, 2.2, 2e-3)
    assert solver.bodies.position[0] == pytest.approx([1.0, 0, 1], abs=5e-3)


def test_limits_stop_a_door_where_they_are():
    door = bar("door", 0.25, angular_velocity=(0, 2.0, 0), velocity=(0, 0, -0.5))
    hinge = joint("hinge", "hinge", ("door",), anchor=(0, 0, 2), axis=Y, limits_deg=(-10.0, 45.0))
    solver = scene(door, joints=[hinge])
    farthest = 0.0
    for _ in range(350):
        solver.substep(2e-3)
        farthest = max(farthest, math.degrees(angles(solver)[0]))
    assert farthest == pytest.approx(45.0, abs=1e-6)
    assert math.degrees(angles(solver)[0]) == pytest.approx(45.0, abs=1e-6)  # its weight holds it there


def test_limits_of_more_than_a_turn_are_kept():
    fast = body("wheel", {"type": "cylinder", "radius": 0.2, "height": 0.1}, (0, 0, 1), angular_velocity=(0, 0, 5.0))
    axle = joint("axle", "hinge", ("wheel",), anchor=(0, 0, 1), axis=(0, 0, 1), limits_deg=(0.0, 900.0))
    solver = scene(fast, joints=[axle])
    advance(solver, 3.2, 5e-3)
    assert solver.bodies.angular_velocity[0, 2] == pytest.approx(0.0, abs=1e-9)
    turned = 2.0 * math.atan2(solver.bodies.orientation[0, 3], solver.bodies.orientation[0, 0])
    assert math.degrees(turned) % 360.0 == pytest.approx(180.0, abs=1e-6)


def test_a_ball_leans_no_farther_than_its_cone():
    rod = body("rod", {"type": "box", "size": (0.04, 0.04, 0.5)}, (0, 0, 2.25), angular_velocity=(0.5, 0.3, 0.0))
    cone = joint("ball", "ball", ("rod",), anchor=(0, 0, 2), axis=(0, 0, 1), cone_deg=30.0)
    solver = scene(rod, joints=[cone])
    worst = 0.0
    for _ in range(400):
        solver.substep(2e-3)
        worst = max(worst, math.degrees(math.acos(solver.bodies.rotation()[0, 2, 2])))
    assert worst == pytest.approx(30.0, abs=1e-6)


def test_a_rope_is_slack_until_it_is_taut():
    stone = body("stone", ball(0.05), (0.3, 0, 2))
    rope = joint("rope", "rope", ("stone",), anchors=((0.3, 0, 2), (0, 0, 2)), length=0.5)
    solver = scene(stone, joints=[rope])
    fall = math.sqrt(0.5**2 - 0.3**2)
    free_s = math.sqrt(2.0 * fall / GRAVITY)
    steps = math.floor(free_s / 2e-3)
    advance(solver, steps * 2e-3, 2e-3)
    assert solver.bodies.position[0, 2] == pytest.approx(2.0 - 0.5 * GRAVITY * (steps * 2e-3) ** 2, abs=1e-12)
    lengths = []
    for _ in range(500):
        solver.substep(2e-3)
        lengths.append(np.linalg.norm(solver.bodies.position[0] - [0, 0, 2]))
    assert max(lengths) == pytest.approx(0.5, abs=1e-9)
    # What it had across the rope when that became taut is left, and swings.
    across = GRAVITY * free_s * 0.3 / 0.5
    mass = DENSITY * 4.0 / 3.0 * math.pi * 0.05**3
    left = mass * (0.5 * across**2 + GRAVITY * (2.0 - fall))
    assert energy(solver) == pytest.approx(left, rel=5e-3)


@pytest.mark.parametrize("damping_share", [0.0, 0.1])
def test_a_spring_swings_at_its_frequency_and_its_damper_takes_its_share(damping_share):
    mass = DENSITY * 0.1**3
    pulse = 2.0 * math.pi * 2.0
    stiffness = mass * pulse**2
    spring = joint(
        "spring",
        "spring",
        ("weight",),
        anchors=((0, 0, 1.6), (0, 0, 2)),
        length=0.3,
        stiffness=stiffness,
        damping=2.0 * damping_share * mass * pulse,
    )
    solver = scene(body("weight", cube(0.1), (0, 0, 1.6)), joints=[spring], gravity=(0, 0, 0))
    dt, decay = 1e-3, damping_share * pulse
    swing = pulse * math.sqrt(1.0 - damping_share**2)
    for count in range(700):
        solver.substep(dt)
        t = (count + 1) * dt
        exact = 0.1 * math.exp(-decay * t) * (math.cos(swing * t) + decay / swing * math.sin(swing * t))
        assert 1.7 - solver.bodies.position[0, 2] == pytest.approx(exact, abs=1.5e-4)  # (omega dt)²/12 of the phase


def test_a_rod_keeps_its_length_and_a_fixed_pair_is_one_body():
    pair = [bar("a", -0.25, angular_velocity=(0.3, 2.0, 1.0)), bar("b", 0.25, velocity=(0, 0, 0.4))]
    solver = scene(*pair, joints=[joint("glue", "fixed", ("a", "b"))], gravity=(0, 0, 0))
    whole = scene(body("whole", {"type": "box", "size": (1.0, 0.04, 0.04)}, (0, 0, 2)), joints=[], gravity=(0, 0, 0))
    solver.substep(1e-9)  # the joint makes them move as one
    momentum, spin = totals(solver, "momentum"), totals(solver, "angular_momentum")
    whole.bodies.velocity[0] = momentum / whole.bodies.mass[0]
    about = spin - np.cross(whole.bodies.position[0], momentum)
    whole.bodies.angular_velocity = np.einsum("nij,j->ni", whole.bodies.inverse_inertia(), about)
    for each in (solver, whole):
        advance(each, 1.0, 1e-3)
    np.testing.assert_allclose(solver.bodies.position.mean(axis=0), whole.bodies.position[0], atol=1e-9)
    np.testing.assert_allclose(
        solver.bodies.angular_velocity, np.repeat(whole.bodies.angular_velocity, 2, axis=0), atol=2e-4
    )

    rod = joint("rod", "distance", ("a", "b"))
    solver = scene(
        body("a", ball(0.05), (0, 0, 2)), body("b", ball(0.05), (0.4, 0, 2), velocity=(0, 3, 0)), joints=[rod]
    )
    advance(solver, 1.0)
    assert np.linalg.norm(np.diff(solver.bodies.position, axis=0)) == pytest.approx(0.4, abs=1e-9)


def chain(links: int, ratio: float) -> RigidSolver:
    """A chain from the level, of balls and a weight of so many times the mass of a link at its end."""
    length = 0.1
    shape = {"type": "capsule", "radius": 0.01, "height": 0.06}
    bodies = [body(f"link{k}", shape, ((k + 0.5) * length, 0, 3), rotation_deg=(0, 90, 0)) for k in range(links)]
    mass = DENSITY * (math.pi * 0.01**2 * 0.06 + 4 / 3 * math.pi * 0.01**3)
    edge = 0.1
    bodies.append(body("weight", cube(edge), (links * length, 0, 3), density=ratio * mass / edge**3))
    names = [each.name for each in bodies]
    joints = [joint("top", "ball", ("link0",), anchor=(0, 0, 3))]
    joints += [
        joint(f"j{k}", "ball", pair, anchor=((k + 1) * length, 0, 3))
        for k, pair in enumerate(itertools.pairwise(names))
    ]
    return scene(*bodies, joints=joints)


def test_a_chain_with_a_hundredfold_weight_does_not_stretch_and_keeps_its_energy():
    solver = chain(10, 100.0)
    start, dropped = energy(solver), solver.bodies.mass[-1] * GRAVITY
    for _ in range(200):
        solver.substep(2e-3)
        assert np.linalg.norm(solver.bodies.position[-1] - [0, 0, 3]) < 1.0 + 1e-9
        assert abs(energy(solver) - start) < 0.01 * dropped
    assert gap(solver) < 1e-9
    assert solver.diagnostics()["joints_apart"] == 0.0


def test_joints_change_no_momentum():
    rng = np.random.default_rng(3)
    bodies = [
        bar(name, 0.5 * k, velocity=tuple(rng.normal(size=3)), angular_velocity=tuple(3.0 * rng.normal(size=3)))
        for k, name in enumerate("abcde")
    ]
    joints = [
        joint("j0", "hinge", ("a", "b"), anchor=(0.25, 0, 2), axis=(0, 1, 1), motor={"speed": 4.0, "max_torque": 0.5}),
        joint("j1", "ball", ("b", "c"), anchor=(0.75, 0, 2), axis=(1, 0, 0), cone_deg=40.0),
        joint("j2", "slider", ("c", "d"), axis=(0, 0, 1), limits=(-0.1, 0.1)),
        joint("j3", "spring", ("a", "d"), stiffness=50.0, damping=1.0),
        joint("j4", "rope", ("b", "e"), length=1.6),
        joint("j5", "fixed", ("d", "e")),
    ]
    solver = scene(*bodies, joints=joints, gravity=(0, 0, 0))
    linear, angular = totals(solver, "momentum"), totals(solver, "angular_momentum")
    advance(solver, 1.0, 2e-3)
    size = solver.bodies.mass.sum()
    np.testing.assert_allclose(totals(solver, "momentum"), linear, atol=1e-11 * size)
    np.testing.assert_allclose(totals(solver, "angular_momentum"), angular, atol=1e-10 * size)


@pytest.mark.parametrize(("share", "holds"), [(1.02, True), (0.98, False)])
def test_a_joint_breaks_at_its_force_and_not_before(share, holds):
    weight = DENSITY * 0.1**3 * GRAVITY
    hook = joint("hook", "ball", ("lamp",), anchor=(0, 0, 2), breaks_at=share * weight)
    solver = scene(body("lamp", cube(0.1), (0, 0, 1.9)), joints=[hook])
    advance(solver, 0.2, 2e-3)
    assert solver.diagnostics()["joints_broken"] == (0.0 if holds else 1.0)
    fallen = 0.0 if holds else 0.5 * GRAVITY * 0.198**2  # it let go after the first step
    assert 1.9 - solver.bodies.position[0, 2] == pytest.approx(fallen, abs=1e-9)


@pytest.mark.parametrize(("share", "holds"), [(1.02, True), (0.98, False)])
def test_a_fixed_joint_breaks_at_its_torque(share, holds):
    torque = MASS * GRAVITY * 0.25
    solver = scene(
        bar("arm", 0.25), joints=[joint("weld", "fixed", ("arm",), anchor=(0, 0, 2), breaks_at_torque=share * torque)]
    )
    advance(solver, 0.1, 2e-3)
    assert solver.diagnostics()["joints_broken"] == (0.0 if holds else 1.0)


def test_a_led_body_pulls_what_hangs_on_it():
    led = body("hand", cube(0.05), (0, 0, 2), kind="kinematic", velocity=(0.5, 0.0, 0.0))
    hang = joint("string", "distance", ("bob", "hand"), anchors=((0, 0, 1.5), (0, 0, 2)))
    solver = scene(led, body("bob", ball(0.05), (0, 0, 1.5)), joints=[hang])
    for _ in range(500):
        solver.substep(2e-3)
        assert np.linalg.norm(np.diff(solver.bodies.position, axis=0)) == pytest.approx(0.5, abs=1e-9)
    # In the frame of the hand a pendulum that was pushed: its energy there is kept.
    velocity = solver.bodies.velocity[1] - [0.5, 0, 0]
    spin = 0.0  # the string holds it at its centre
    kept = 0.5 * velocity @ velocity + GRAVITY * (solver.bodies.position[1, 2] - 1.5) + spin
    assert kept == pytest.approx(0.5 * 0.5**2, rel=2e-3)


def touching_scene() -> RigidSolver:
    """A chain that falls onto a floor with a loose box, and a cart whose wheel a motor turns, its tail on the floor."""
    bodies = [bar(f"l{k}", 0.5 * k, 0.3 + 0.01 * k, velocity=(0, 0.2, -1)) for k in range(3)]
    bodies += [body("box", cube(0.15), (0.6, 0, 0.08)), body("wheel", ball(0.1), (-0.8, 0, 0.1), friction=0.8)]
    cart = {"type": "box", "size": (0.5, 0.3, 0.05)}
    bodies.append(body("cart", cart, (-1.0, 0, 0.1), friction=0.0))
    joints = [
        joint("j0", "ball", ("l0", "l1"), anchor=(0.25, 0, 0.3), breaks_at=40.0),
        joint("j1", "hinge", ("l1", "l2"), anchor=(0.75, 0, 0.31), axis=Y, limits_deg=(-40, 40)),
        joint("rope", "rope", ("l2", "box"), length=0.6),
        joint("axle", "hinge", ("wheel", "cart"), anchor=(-0.8, 0, 0.1), axis=Y, motor={"speed": 6, "max_torque": 2}),
    ]
    return RigidSolver(bodies, joints=joints, domain=ROOM, gravity=(0, 0, -GRAVITY))


def test_what_touches_and_hangs_together_rests_and_drives():
    solver = touching_scene()
    solver.has_own_steps = True
    advance(solver, 0.6, 2e-3)
    diagnostics = solver.diagnostics()
    assert diagnostics["max_penetration"] < 2e-3
    assert diagnostics["joint_gap"] < 1e-6
    # The wheel rolls: 6 rad/s at a radius of 0.1 m.
    assert solver.bodies.velocity[5, 0] == pytest.approx(0.6, rel=0.02)


@pytest.mark.parametrize("later_s", [0.0, 0.1])
def test_a_scene_restored_after_a_joint_breaks_goes_on_with_the_same_bits(later_s):
    solver, restored = touching_scene(), touching_scene()
    for each in (solver, restored):
        each.has_own_steps = True
    while solver.diagnostics()["joints_broken"] == 0.0 and solver.time_s < 0.2:
        solver.substep(2e-3)
    advance(solver, later_s, 2e-3)
    assert solver.diagnostics()["joints_broken"] == 1.0  # the blow on the floor
    restored.restore(solver.checkpoint())
    for each in (solver, restored):
        advance(each, 0.1, 2e-3)
    for name, array in solver.checkpoint().items():
        np.testing.assert_array_equal(array, restored.checkpoint()[name], err_msg=name)


def test_a_checkpoint_without_joints_is_refused():
    solver = touching_scene()
    arrays = {name: array for name, array in solver.checkpoint().items() if name != "joints_broken"}
    with pytest.raises(ValueError, match=r"joints_broken must have shape \(4,\)"):
        solver.restore(arrays)


def test_a_pendulum_hit_by_a_ball_takes_the_blow_at_its_hinge():
    # A ball hits a rod at its end, e = 1: energy and the angular momentum about the hinge are kept.
    rod = body("rod", {"type": "box", "size": (0.04, 0.04, 0.5)}, (0, 0, 2.0), restitution=1.0)
    hit = body("ball", ball(0.03), (-0.1, 0, 1.8), velocity=(2.0, 0, 0), restitution=1.0)
    hinge = joint("hinge", "hinge", ("rod",), anchor=(0, 0, 2.25), axis=Y)
    solver = scene(rod, hit, joints=[hinge], gravity=(0, 0, 0))
    advance(solver, 0.06, 1e-3)
    mass = DENSITY * 4.0 / 3.0 * math.pi * 0.03**3
    moment = DENSITY * 0.04**2 * 0.5 * ((0.5**2 + 0.04**2) / 12.0 + 0.25**2)
    arm = 0.45
    spin = 2.0 * mass * 2.0 * arm / (moment + mass * arm**2)
    assert -solver.bodies.angular_velocity[0, 1] == pytest.approx(spin, rel=2e-3)
    assert energy(solver) == pytest.approx(0.5 * mass * 2.0**2, rel=2e-3)


@pytest.mark.parametrize("contacts", [False, True])
def test_joined_bodies_touch_only_where_they_are_told_to(contacts):
    post = body("post", cube(0.1), (0.2, 0, 1.8), kind="static")
    hinge = joint("hinge", "hinge", ("door", "post"), anchor=(0, 0, 2), axis=Y, contacts=contacts)
    solver = scene(bar("door", 0.25), joints=[hinge], obstacles=[post])
    advance(solver, 0.4, 2e-3)
    assert (math.degrees(angles(solver)[0]) < 60.0) == contacts


def test_what_hangs_still_sleeps_and_is_woken_with_all_that_it_hangs_on():
    joints = [joint(f"j{k}", "ball", pair, anchor=(0, 0, 2 - 0.2 * k)) for k, pair in enumerate([("a",), ("a", "b")])]
    shape = {"type": "box", "size": (0.04, 0.04, 0.2)}
    solver = scene(body("a", shape, (0, 0, 1.9)), body("b", shape, (0, 0, 1.7)), joints=joints)
    advance(solver, 0.7, 5e-3)
    assert solver.bodies.is_asleep.all()
    solver.push("b", np.array([0.5, 0.0, 0.0]))
    solver.substep(2e-3)
    assert not solver.bodies.is_asleep.any()


def test_loops_that_fight_are_told_and_do_not_explode():
    bodies = [bar("a", 0.25), body("led", cube(0.05), (0.5, 0, 2.0), kind="kinematic", velocity=(0.1, 0, 0))]
    joints = [
        joint("wall", "ball", ("a",), anchor=(0, 0, 2)),
        joint("hand", "ball", ("a", "led"), anchor=(0.5, 0, 2)),
        joint("key", "fixed", ("key", "led"), anchor=(0.6, 0, 2)),
    ]
    bodies.append(body("key", cube(0.04), (0.6, 0, 2.0)))
    solver = scene(*bodies, joints=joints)
    advance(solver, 0.1, 2e-3)
    diagnostics = solver.diagnostics()
    # Those of the loop are named, and what merely hangs on it is not.
    assert {name for name in diagnostics if name.startswith("joints_apart_")} <= {
        "joints_apart_wall",
        "joints_apart_hand",
    }
    assert diagnostics.get("joints_apart_wall", 0.0) + diagnostics.get("joints_apart_hand", 0.0) > 10
    assert diagnostics["joints_apart"] > 10
    assert diagnostics["joint_gap"] == pytest.approx(0.01, rel=0.7)  # the two ends are 1 cm too far apart
    assert diagnostics["max_speed"] < 1.0


def digest_after_some_time() -> str:
    solver = touching_scene()
    solver.has_own_steps = True
    advance(solver, 0.16, 2e-3)
    return digest_of(solver.checkpoint())


def test_joints_and_contacts_do_not_depend_on_the_number_of_threads():
    result_on_any_threads(digest_after_some_time)


def test_a_wheel_on_its_axle_answers_a_fluid_by_turning_alone():
    wheel = body("wheel", {"type": "cylinder", "radius": 0.2, "height": 0.1}, (0, 0, 1))
    free = body("free", ball(0.1), (0.5, 0, 1))
    axle = joint("axle", "hinge", ("wheel",), anchor=(0, 0, 1), axis=(0, 0, 1))
    solver = scene(wheel, free, joints=[axle])
    inverse_mass, inverse_inertia = solver.mobility()
    assert inverse_mass == pytest.approx([0.0, 1.0 / solver.bodies.mass[1]], abs=1e-12)
    around = solver.bodies.inverse_inertia()
    np.testing.assert_allclose(inverse_inertia[0], np.diag([0, 0, around[0, 2, 2]]), atol=1e-9 * around[0, 2, 2])
    np.testing.assert_array_equal(inverse_inertia[1], around[1])
