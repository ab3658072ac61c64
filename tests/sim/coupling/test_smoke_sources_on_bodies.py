"""Sources of smoke that follow rigid bodies: where they are, how fast, and what they leave behind."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from thread_counts import digest_of

from sim.build import build_world
from sim.core.domain import DomainParameters
from sim.coupling.smoke_sources import SmokeSourcesOnBodies, placed_on, with_sources_on
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.solver import RigidSolver
from sim.scene import SceneParameters
from sim.smoke.parameters import SmokeParameters, SmokeSourceParameters
from sim.smoke.source_motion import BodyMotion, motion_of

DOMAIN = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.6, 0.6, 0.6))
CELL = 0.05
EXHAUST = {
    "shape": {"type": "sphere", "radius": 0.1},
    "position": (-0.2, 0.05, 0.0),
    "rotation_deg": (0.0, 0.0, 90.0),
    "temperature": 293.0,
    "follow": "car",
}
CAR = {
    "name": "car",
    "kind": "kinematic",
    # Its centre of mass is not its origin: a cone's is a quarter of its height above the base.
    "shape": {"type": "cone", "radius": 0.1, "height": 0.2},
    "position": (0.45, 0.3, 0.3),
    "rotation_deg": (10.0, 20.0, 30.0),
    "velocity": (1.0, 0.1, -0.2),
    "angular_velocity": (0.3, -0.5, 2.0),
}


def test_a_source_is_where_its_body_takes_it_and_as_fast_as_that_place():
    rigid = RigidSolver([RigidBodyParameters(**CAR)], obstacles=[], domain=DOMAIN, gravity=(0.0, 0.0, -9.81))
    parameters = SmokeSourceParameters(**EXHAUST)
    motion = motion_of(parameters, 0.1)
    assert isinstance(motion, BodyMotion)
    smoke = SimpleNamespace(name="fume", time_s=0.0, sources=[SimpleNamespace(parameters=parameters, motion=motion)])
    coupling = SmokeSourcesOnBodies(rigid, smoke)
    dt = 0.125
    for _ in range(5):
        rigid.substep(dt / 5)
    coupling.exchange(dt)
    poses = motion.poses(0.0, dt, spacing=0.01)
    spin, velocity = np.array(CAR["angular_velocity"]), np.array(CAR["velocity"])
    start = Rotation.from_euler("xyz", CAR["rotation_deg"], degrees=True)
    for number, pose in enumerate(poses):
        time = dt * number / (len(poses) - 1)
        turned = Rotation.from_rotvec(spin * time) * start
        arm = turned.apply(EXHAUST["position"])
        assert pose.position == pytest.approx(np.array(CAR["position"]) + velocity * time + arm, abs=1e-12)
        assert pose.velocity == pytest.approx(velocity + np.cross(spin, arm), abs=1e-12)
        own = turned * Rotation.from_euler("z", 90.0, degrees=True)
        matrix = Rotation.from_quat(pose.orientation, scalar_first=True).as_matrix()
        assert matrix == pytest.approx(own.as_matrix(), abs=1e-12)
    # No point of it moves by more than asked for from pose to pose.
    ways = np.linalg.norm(np.diff([pose.position for pose in poses], axis=0), axis=1)
    assert len(poses) > 10
    assert ways.max() < 0.01
    # From there it goes on as the body moves.
    smoke.time_s = dt
    coupling.resume()
    here, *ahead = motion.poses(dt, 2.0 * dt, spacing=0.01)
    assert here.position == pytest.approx(poses[-1].position, abs=1e-12)
    arm = (Rotation.from_rotvec(2.0 * dt * spin) * start).apply(EXHAUST["position"])
    assert ahead[-1].position == pytest.approx(np.array(CAR["position"]) + 2.0 * dt * velocity + arm, abs=1e-9)


@pytest.mark.parametrize("grid", ["window", "box"])
def test_a_run_that_goes_on_has_the_bits_of_one_that_was_restored(grid, taichi_cpu):
    """A window around an exhaust that a body takes along, and one that blows on a body that the air slows."""
    led = {"kind": "kinematic", "velocity": (3.0, 0.0, 0.0)}
    free = {"kind": "dynamic", "density": 3.0, "velocity": (1.0, 0.0, 0.0)}
    ball = {"name": "ball", "shape": {"type": "sphere", "radius": 0.15}, "position": (0.8, 0.8, 0.8)}
    source = {"shape": {"type": "sphere", "radius": 0.2}, "temperature": 293.0, "follow": "ball"}
    blows = {} if grid == "window" else {"velocity": (0.0, 0.0, 0.5)}
    faces = ("x-", "x+", "y-", "y+", "z-", "z+")
    air = {"name": "air", "cell_size": 0.1, "open_faces": faces, "grid": grid, "source": ({**source, **blows},)}
    scene = SceneParameters(
        domain={"min": (0.0, 0.0, 0.0), "max": (4.8, 1.6, 1.6), "open_faces": faces},
        gravity=(0.0, 0.0, 0.0),
        smoke=(air,),
        rigid=({**ball, **(led if grid == "window" else free)},),
    )
    goes_on, restored = (build_world(scene, frames_per_second=24) for _ in range(2))
    for frame in range(1, 9):
        goes_on.advance_frame()
        kept = {name: array.copy() for name, array in goes_on.checkpoint().items()}
        if frame > 1:
            assert digest_of(kept) == digest_of(restored.checkpoint())
        restored.restore(frame, kept)
        restored.advance_frame()


def test_a_source_on_a_static_body_is_placed_with_it():
    wall = RigidBodyParameters(**{key: CAR[key] for key in ("name", "shape", "position", "rotation_deg")})
    source = SmokeSourceParameters(**EXHAUST, velocity=(1.0, 0.0, 0.0))
    placed = placed_on(source, wall)
    turned = Rotation.from_euler("xyz", CAR["rotation_deg"], degrees=True)
    assert placed.position == pytest.approx(np.array(CAR["position"]) + turned.apply(EXHAUST["position"]))
    assert placed.velocity == pytest.approx(turned.apply([1.0, 0.0, 0.0]))
    own = turned * Rotation.from_euler("z", 90.0, degrees=True)
    angles = Rotation.from_euler("xyz", placed.rotation_deg, degrees=True)
    assert angles.as_matrix() == pytest.approx(own.as_matrix())
    assert not placed.moves
    smoke = SmokeParameters(name="fume", source=[source])
    assert with_sources_on(smoke, [wall]).source == (placed,)
    with pytest.raises(ValueError, match='smoke "fume", source 0: no rigid body is named "car"'):
        with_sources_on(smoke, [])


def test_an_exhaust_leaves_its_way_full_of_smoke_and_goes_on_after_a_restart(taichi_cpu):
    # A small body pulls a source through air at rest, ten cells a frame.
    car = {
        "name": "car",
        "kind": "kinematic",
        "shape": {"type": "box", "size": (0.1, 0.1, 0.1)},
        "position": (0.4, 0.3, 0.3),
        "velocity": (5.0, 0.0, 0.0),
    }
    exhaust = {**EXHAUST, "position": (-0.2, 0.0, 0.0)}
    scene = SceneParameters(
        gravity=(0.0, 0.0, 0.0),
        domain=DOMAIN,
        rigid=[car],
        smoke=[
            {
                "name": "fume",
                "cell_size": CELL,
                "source": [exhaust],
                "vorticity_confinement": 0.0,
                "open_faces": ("x-", "x+", "y-", "y+", "z-", "z+"),
            }
        ],
    )
    world = build_world(scene, frames_per_second=10)
    start = world.checkpoint()
    world.advance_frame()
    half = world.checkpoint()
    world.advance_frame()
    density = world.snapshots()["fume"].arrays["density"]
    # From x = 0.2 to 1.2 m: all along the middle there is smoke, but where the body is now.
    middle = density[:, 5:7, 5:7].mean(axis=(1, 2))
    x = (0.5 + np.arange(len(middle))) * CELL
    assert middle[(x > 0.2) & (x < 1.2)].min() > 0.5
    assert middle[x > 1.5].max() < 0.1
    whole = world.checkpoint()
    world.restore(0, start)
    world.restore(1, half)
    world.advance_frame()
    for name, array in world.checkpoint().items():
        assert np.array_equal(array, whole[name]), name
