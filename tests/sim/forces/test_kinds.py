"""What forces from outside do to each kind of body, against formulas."""

import math
from typing import Any

import numpy as np
import pytest
from thread_counts import digest_of, result_on_threads

from sim.build import build_world
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

FREE = {"gravity": (0.0, 0.0, 0.0), "domain": {"min": (-2.0, -2.0, -2.0), "max": (2.0, 2.0, 2.0)}}
BALL = {"name": "ball", "kind": "dynamic", "density": 500.0, "shape": {"type": "sphere", "radius": 0.1}}
SHEET = {
    "name": "sheet",
    "shape": {"type": "rectangle", "size": (0.3, 0.3), "counts": (5, 5)},
    "air_density": 0.0,
    "position": (0.0, 0.6, 0.0),
}
DROP = {
    "name": "drop",
    "particle_radius": 0.02,
    "block": [{"shape": {"type": "sphere", "radius": 0.06}, "position": (0.0, -0.6, 0.0)}],
}


def world_of(**tables: Any) -> Any:
    return build_world(SceneParameters.model_validate({**FREE, **tables}), frames_per_second=60)


def mean_velocity(world: Any, name: str) -> np.ndarray:
    arrays = world.snapshots()[name].arrays
    key = "linear_velocity" if "linear_velocity" in arrays else "velocity"
    return np.asarray(arrays[key], np.float64).reshape(-1, 3).mean(axis=0)


def test_gravity_gives_all_kinds_the_same_velocity():
    force = {"type": "gravity", "acceleration": (2.0, 0.0, -1.0), "start_s": 0.05, "end_s": 0.15}
    world = world_of(rigid=[BALL], cloth=[SHEET], fluid=[DROP], force=[force])
    for _ in range(12):
        world.advance_frame()
    for name in ("ball", "sheet", "drop"):
        assert mean_velocity(world, name) == pytest.approx((0.2, 0.0, -0.1), rel=0.03, abs=1e-4), name


def test_drag_takes_the_same_part_of_all_velocities_and_of_spin():
    given = {"velocity": (0.6, 0.0, 0.0)}
    block = {"shape": {"type": "sphere", "radius": 0.06}, "position": (0.0, -0.6, 0.0), **given}
    ball = BALL | given | {"angular_velocity": (0.0, 3.0, 0.0)}
    world = world_of(
        rigid=[ball], cloth=[SHEET | given], fluid=[DROP | {"block": [block]}], force=[{"type": "drag", "rate": 2.0}]
    )
    for _ in range(30):
        world.advance_frame()
    for name in ("ball", "sheet", "drop"):
        assert mean_velocity(world, name)[0] == pytest.approx(0.6 * math.exp(-1.0), rel=0.01), name
    spin = world.snapshots()["ball"].arrays["angular_velocity"]
    assert spin[1] == pytest.approx(3.0 * math.exp(-1.0), rel=1e-5)


def test_a_ball_swings_about_an_attractor():
    """Inside its radius the pull is that of a spring: omega² = a/R."""
    force = {"type": "attractor", "position": (0.0, 0.0, 0.0), "acceleration": 9.0, "radius": 1.0}
    world = world_of(rigid=[BALL | {"position": (0.5, 0.0, 0.0)}], force=[force])
    places = []
    for _ in range(63):  # 2 pi/3 s are 125.7 frames
        world.advance_frame()
        places.append(world.snapshots()["ball"].arrays["position"][0])
    assert places[-1] == pytest.approx(-0.5 * math.cos(3.0 * (63.0 / 60.0) - math.pi), abs=0.005)
    assert min(places) == pytest.approx(-0.5, abs=0.005)


@pytest.mark.parametrize(
    ("shape", "area", "coefficient"),
    [
        ({"type": "box", "size": (0.3, 0.3, 0.01)}, 0.09, 1.0),
        ({"type": "sphere", "radius": 0.1}, math.pi * 0.01, 0.5),
    ],
)
def test_a_light_body_falls_in_air_at_its_terminal_speed(shape, area, coefficient):
    """A plate of 20 kg/m³ fell as in a vacuum. A ball's drag is half of a plate's: the mean of cos² over its shadow."""
    body = {"name": "body", "kind": "dynamic", "density": 20.0, "shape": shape, "position": (0.0, 0.0, 20.0)}
    domain = {"min": (-2.0, -2.0, -40.0), "max": (2.0, 2.0, 40.0), "open_faces": ("z-",)}
    world = world_of(rigid=[body], force=[{"type": "wind"}], gravity=(0.0, 0.0, -9.81), domain=domain)
    for _ in range(150):
        world.advance_frame()
    mass = 20.0 * (0.3 * 0.3 * 0.01 if shape["type"] == "box" else 4.0 / 3.0 * math.pi * 0.001)
    terminal = math.sqrt(2.0 * mass * 9.81 / (1.2 * coefficient * area))
    assert -mean_velocity(world, "body")[2] == pytest.approx(terminal, rel=0.03)


def test_a_plate_aslant_is_lifted_by_the_wind():
    """Newton's law on a flat plate: its force is along its normal."""
    plate = {"name": "plate", "kind": "dynamic", "density": 2000.0, "shape": {"type": "box", "size": (0.4, 0.4, 0.002)}}
    plate |= {"rotation_deg": (0.0, 30.0, 0.0)}
    world = world_of(rigid=[plate], force=[{"type": "wind", "velocity": (10.0, 0.0, 0.0)}])
    world.advance_frame()
    push = mean_velocity(world, "plate") * 60.0 * 2000.0 * 0.4 * 0.4 * 0.002
    normal = 0.5 * 1.2 * (10.0 * math.sin(math.radians(30.0))) ** 2 * 0.16
    assert push == pytest.approx((0.5 * normal, 0.0, math.cos(math.radians(30.0)) * normal), rel=0.05, abs=0.01)


def test_air_moves_a_glued_body_as_it_moves_the_whole_until_it_breaks():
    """So light that it nearly takes on the wind within a step, and turning: nothing blows onto faces that are glued."""
    box = {"kind": "dynamic", "density": 1.0, "shape": {"type": "box", "size": (0.3, 0.2, 0.1)}}
    box |= {"velocity": (0.0, 1.0, 0.0), "angular_velocity": (2.0, 3.0, -1.0)}
    breaks = {"strength": 1.0e6, "pieces": 6}
    whole, glued = box | {"name": "whole"}, box | {"name": "glued", "breaks": breaks, "position": (0.0, 0.0, 1.0)}
    force = [{"type": "wind", "velocity": (10.0, 2.0, 0.0)}, {"type": "drag", "rate": 0.5}]
    solver = (world := world_of(rigid=[whole, glued], force=force)).solvers["rigid"]
    start = {name: solver.bodies.names.index(name) for name in ("whole", "glued_1")}
    for _ in range(6):
        world.advance_frame()
    movers, one, two = solver.glue.movers, *start.values()
    assert solver.glue.leader[two] == two
    assert movers.velocity[one, 0] > 3.0
    # Triangles are others, and with them where on a face the wind from ahead becomes one from behind.
    np.testing.assert_allclose(movers.velocity[two], movers.velocity[one], atol=1e-3)
    np.testing.assert_allclose(movers.angular_velocity[two], movers.angular_velocity[one], atol=0.02)

    weak = glued | {"breaks": breaks | {"strength": 0.5}}
    worlds = [world_of(rigid=[weak], force=force) for _ in range(2)]
    worlds[0].advance_frame()
    assert worlds[0].solvers["rigid"].glue.is_broken.any()
    worlds[1].restore(1, worlds[0].checkpoint())
    for world in worlds:
        world.advance_frame()
    assert digest_of(worlds[0].checkpoint()) == digest_of(worlds[1].checkpoint())


def test_a_gentle_wind_lets_bodies_sleep_and_a_storm_wakes_them():
    box = {"name": "box", "kind": "dynamic", "density": 500.0, "shape": {"type": "box", "size": (0.2, 0.2, 0.2)}}
    box |= {"position": (0.0, 0.0, -1.9)}
    winds = [
        {"type": "wind", "velocity": (2.0, 0.0, 0.0)},
        {"type": "wind", "velocity": (120.0, 0.0, 0.0), "start_s": 1.0},
    ]
    world = world_of(rigid=[box], force=winds, gravity=(0.0, 0.0, -9.81))
    for _ in range(59):
        world.advance_frame()
    assert world.solvers["rigid"].bodies.is_asleep.all()
    for _ in range(6):
        world.advance_frame()
    assert mean_velocity(world, "box")[0] > 1.0


def test_a_wind_acts_on_cloth_as_its_own_wind_does():
    pinned = {"name": "flag", "shape": {"type": "rectangle", "size": (0.4, 0.3), "counts": (9, 7)}}
    pinned |= {"pin": [{"edge": "x-"}], "rotation_deg": (90.0, 0.0, 0.0)}
    own = world_of(cloth=[pinned | {"wind": (3.0, 2.0, 0.0)}])
    outer = world_of(cloth=[pinned], force=[{"type": "wind", "velocity": (3.0, 2.0, 0.0)}])
    for world in (own, outer):
        for _ in range(10):
            world.advance_frame()
    places = [world.snapshots()["flag"].arrays["position"] for world in (own, outer)]
    assert np.ptp(places[0][:, 1]) > 0.02
    assert places[1] == pytest.approx(places[0], abs=1e-6)


def test_a_wind_carries_spray_as_the_wind_of_its_air_does():
    air = {"air_density": 1.2}
    own = world_of(fluid=[DROP | air | {"wind": (20.0, 0.0, 0.0)}])
    outer = world_of(fluid=[DROP | air], force=[{"type": "wind", "velocity": (20.0, 0.0, 0.0)}])
    for world in (own, outer):
        for _ in range(6):
            world.advance_frame()
    assert mean_velocity(own, "drop")[0] > 0.02
    assert mean_velocity(outer, "drop") == pytest.approx(mean_velocity(own, "drop"), rel=1e-3, abs=1e-6)


SMOKE = {
    "name": "plume",
    "cell_size": 0.05,
    "source": [{"shape": {"type": "sphere", "radius": 0.2}, "temperature": 293.0, "end_s": 0.02, "fluctuation": 0.0}],
    "min": (-1.0, -1.0, -1.0),
    "max": (1.0, 1.0, 1.0),
    "open_faces": ("x-", "x+", "y-", "y+", "z-", "z+"),
    "buoyancy_density": 0.0,
    "vorticity_confinement": 0.0,
}


def middle_of_smoke(world: Any) -> np.ndarray:
    snapshot = world.snapshots()["plume"]
    density = np.asarray(snapshot.arrays["density"], np.float64)
    centres = np.moveaxis(np.indices(density.shape), 0, -1) + 0.5
    return -1.0 + 0.05 * np.einsum("xyz,xyzc->c", density, centres) / density.sum()


def test_the_air_of_a_smoke_takes_on_the_wind_within_its_response():
    """u = U (1 - exp(-t/tau)), so the way is U (t - tau (1 - exp(-t/tau)))."""
    wind = {"type": "wind", "velocity": (0.8, 0.0, 0.0), "response_s": 0.2}
    world = world_of(smoke=[SMOKE], force=[wind])
    for _ in range(36):
        world.advance_frame()
    way = 0.8 * (0.6 - 0.2 * (1.0 - math.exp(-3.0)))
    assert middle_of_smoke(world) == pytest.approx((way, 0.0, 0.0), abs=0.02)


def test_an_attractor_draws_smoke():
    force = {"type": "attractor", "position": (0.0, 0.6, 0.0), "acceleration": 4.0, "radius": 0.2, "falloff": 1.0}
    world = world_of(smoke=[SMOKE], force=[force])
    for _ in range(30):
        world.advance_frame()
    assert middle_of_smoke(world)[1] > 0.05
    assert np.abs(middle_of_smoke(world)[[0, 2]]).max() < 1e-3


def test_gravity_that_is_added_lifts_hot_smoke_as_that_of_the_job():
    hot = SMOKE | {"source": [SMOKE["source"][0] | {"temperature": 350.0}], "cooling": 0.0, "buoyancy_density": 0.1}
    down = (0.0, 0.0, -9.81)
    of_job = world_of(smoke=[hot], gravity=down)
    added = world_of(smoke=[hot], force=[{"type": "gravity", "acceleration": down}])
    for world in (of_job, added):
        for _ in range(20):
            world.advance_frame()
    assert middle_of_smoke(of_job)[2] > 0.05
    assert middle_of_smoke(added) == pytest.approx(middle_of_smoke(of_job), abs=2e-3)


def test_forces_on_nobody_are_refused():
    nobody = {"type": "drag", "rate": 1.0, "only": ("nobody",)}
    with pytest.raises(ValueError, match='"nobody" is the name of no body, group, fluid, cloth, smoke or soft body'):
        world_of(rigid=[BALL], force=[nobody])


def run_with_forces(checkpoint: str, resume: bool) -> str:
    """Four frames of everything in gusts, turbulence and a vortex; a checkpoint after the second, or on from there."""
    forces = [
        {"type": "wind", "velocity": (2.0, 0.0, 0.0), "gusts": 0.5, "gust_s": 0.03},
        {"type": "turbulence", "speed": 0.5, "size": 0.5, "rate": 5.0},
        {"type": "vortex", "position": (0.0, 0.0, 0.0), "speed": 1.0, "radius": 0.5},
        {"type": "attractor", "position": (0.0, 0.0, 0.5), "acceleration": 2.0, "radius": 0.5},
        {"type": "drag", "rate": 0.5, "only": ["drop", "ball"]},
    ]
    world = world_of(
        rigid=[BALL],
        cloth=[SHEET | {"air_density": 1.2}],
        fluid=[DROP | {"air_density": 1.2}],
        smoke=[SMOKE],
        force=forces,
    )
    if resume:
        with np.load(checkpoint) as arrays:
            world.restore(2, dict(arrays))
    while world.frame < 4:
        world.advance_frame()
        if not resume and world.frame == 2:
            np.savez(checkpoint, **world.checkpoint())
    return digest_of(world.checkpoint())


@pytest.mark.slow
def test_what_forces_do_has_the_same_bits_after_a_kill_and_on_more_threads(taichi_cpu, tmp_path):
    if taichi_cpu != "cpu":
        pytest.skip("compares numbers of threads")
    checkpoint = str(tmp_path / "checkpoint.npz")
    whole = result_on_threads(1, run_with_forces, checkpoint, False)
    assert result_on_threads(2, run_with_forces, checkpoint, True) == whole
