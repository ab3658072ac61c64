"""What a fluid knows of the motion of bodies: how fast they will become, and how far they got."""

import numpy as np
import pytest
from coupled_tanks import EARTH, SPACING, Tank

from sim.build import build_world
from sim.core.domain import DomainParameters
from sim.coupling.body_speed import expected_body_speed
from sim.fluid.boundary import BodyStates
from sim.rigid.parameters import RigidBodyParameters
from sim.scene import SceneParameters
from sim.shapes.body_geometry import BodyGeometry

BOX = {"name": "box", "shape": {"type": "box", "size": (0.1, 0.1, 0.1)}}
TANK = DomainParameters(min=(0.0, 0.0, 0.0), max=(0.2, 0.2, 0.6))


def body_speed(**body: object) -> float:
    parameters = RigidBodyParameters.model_validate({**BOX, "position": (0.0, 0.0, 0.5), **body})
    return expected_body_speed([parameters], [BodyGeometry(parameters)], TANK, EARTH)


def test_a_dynamic_body_is_expected_to_fall_to_the_floor():
    falls, corner = 2 * 9.81 * 0.5, np.sqrt(3) * 0.05
    assert body_speed(kind="dynamic", density=500.0) == pytest.approx(np.sqrt(falls))
    spinning = body_speed(kind="dynamic", density=500.0, velocity=(3.0, 0.0, -4.0), angular_velocity=(0.0, 2.0, 0.0))
    assert spinning == pytest.approx(np.sqrt(25.0 + falls) + 2.0 * corner)


def test_a_kinematic_body_is_expected_to_become_as_fast_as_its_path():
    assert body_speed(kind="kinematic", velocity=(0.0, 0.0, -4.0)) == pytest.approx(4.0)
    keyframes = [{"time_s": t, "position": (x, 0.0, 0.5)} for t, x in ((0.0, 0.0), (1.0, 1.0), (1.5, 3.0))]
    assert body_speed(kind="kinematic", keyframe=keyframes, interpolation="linear") == pytest.approx(4.0)
    # A single smooth step of 1 m/s on average is at 1.5 m/s half-way.
    assert body_speed(kind="kinematic", keyframe=keyframes[:2]) == pytest.approx(1.5, rel=1e-3)
    assert body_speed(kind="kinematic", keyframe=keyframes[:1]) == 0.0


def test_fluid_expects_the_speed_of_a_body_that_hits_a_shallow_pool(taichi_cpu):
    pool = {"shape": {"type": "box", "size": (0.4, 0.4, 0.16)}, "position": (0.2, 0.2, 0.08)}
    falling = {**BOX, "kind": "dynamic", "density": 1000.0, "position": (0.2, 0.2, 0.25), "velocity": (0, 0, -10)}
    scene = SceneParameters.model_validate(
        {
            "domain": {"min": (0, 0, 0), "max": (0.4, 0.4, 0.8)},
            "fluid": [{"name": "water", "block": [pool]}],
            "rigid": [falling],
        }
    )
    world = build_world(scene, frames_per_second=200.0)
    compressions = [world.advance_frame().diagnostics["water"]["max_compression"] for _ in range(2)]
    # An impact at v raises the density by v/c_s (Joukowsky), a tenth here; by 0.48 where only the pool's fall counted.
    assert max(compressions) < 0.1
    assert world.snapshots()["water"].arrays["velocity"][:, 2].max() > 1.0  # it has hit, and fluid splashes


def test_a_body_that_fluid_carries_moves_by_its_velocity(taichi_cpu):
    side = 12 * SPACING
    domain = DomainParameters(min=(0.0, 0.0, 0.0), max=(side, side, side + 4 * SPACING))
    sphere = {"kind": "dynamic", "density": 1000.0, "shape": {"type": "sphere", "radius": 3 * SPACING}}
    tank = Tank(
        [{**sphere, "position": (side / 2, side / 2, side / 2)}],
        domain=domain,
        water=(domain.min, (side, side, side)),
        solver="dfsph",
    )
    tank.settle(0.05)
    start, way, bound = tank.rigid.bodies.position[0].copy(), np.zeros(3), 0.0
    for _ in range(20):
        dt = tank.step()
        way, bound = way + dt * tank.rigid.bodies.velocity[0], bound + 0.5 * 9.81 * dt**2
    # A fifth of what the sphere would drift at rest if its steps were those of free fall.
    assert np.abs(tank.rigid.bodies.position[0] - start - way).max() < 0.2 * bound
    assert np.abs(tank.coupling.force[0]).max() > 0.0


def test_fluid_finds_a_body_that_started_and_stopped_within_a_step(taichi_cpu):
    def tank_with_a_box_above() -> Tank:
        return Tank(
            [{**BOX, "name": "lid", "kind": "kinematic", "position": (0.1, 0.1, 0.3)}],
            domain=TANK,
            water=((0.0, 0.0, 0.0), (0.2, 0.2, 0.12)),
        )

    densities = {}
    for elapsed_s in (0.0, 1.0e-3):  # put there anew, or moved there
        tank = tank_with_a_box_above()
        tank.fluid.snapshots()  # it knows its neighbours now
        lowered = tank.rigid.bodies.position - (0.0, 0.0, 0.13)
        at_rest = np.zeros((1, 3))
        states = BodyStates(lowered, tank.rigid.bodies.rotation(), at_rest, at_rest)
        tank.fluid.tank.move_bodies(states, elapsed_s=elapsed_s)
        densities[elapsed_s] = tank.fluid.snapshots()["water"].arrays["density"]
    np.testing.assert_array_equal(densities[1.0e-3], densities[0.0])
    # The box has a part in them: it stands on the fluid, half a spacing above the top layer.
    untouched = tank_with_a_box_above().fluid.snapshots()["water"].arrays["density"]
    assert (densities[0.0] - untouched).max() > 50.0
