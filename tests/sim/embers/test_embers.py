"""Embers: how they fall, are carried, come, cool, and stop; and that a run goes on after it was killed."""

import numpy as np
import pytest
from thread_counts import digest_of

from sim.build import build_world
from sim.core.drag import AIR_DENSITY, AIR_VISCOSITY, drag_coefficients
from sim.core.parameters import KeyRefusedError
from sim.embers.parameters import COLD_K
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

FPS = 60
HALL = {"min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.0)}
OPEN = ("x-", "x+", "y-", "y+", "z+")


def world(*, source=(), smoke=(), rigid=(), gravity=(0.0, 0.0, -9.81), domain=(), **embers):
    place = {"shape": {"type": "sphere", "radius": 0.05}, "position": (0.0, 0.0, 0.5), "rate": 300.0, "spread": 0.0}
    still = {"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.5)}
    air = {
        "name": "air",
        "cell_size": 0.05,
        "open_faces": OPEN,
        "source": ({**still, "temperature": 293.0, "density": 0.0},),
        **dict(smoke),
    }
    scene = SceneParameters(
        domain=domain or {**HALL, "open_faces": OPEN},
        gravity=gravity,
        smoke=(air,),
        rigid=rigid,
        embers=({"name": "sparks", "smoke": "air", "source": ({**place, **dict(source)},), **embers},),
    )
    return build_world(scene, frames_per_second=FPS)


def after(world, frames):
    for _ in range(frames):
        world.advance_frame()
    return world.solvers["sparks"].snapshots()["sparks"].arrays


def terminal_speed(diameter, density):
    """Where weight and drag of a sphere are equal, by bisection [m/s]."""
    low, high = 0.0, 50.0
    for _ in range(60):
        speed = 0.5 * (low + high)
        drag = drag_coefficients(np.array(AIR_DENSITY * speed * diameter / AIR_VISCOSITY))
        pull = 0.75 * AIR_DENSITY / density * drag * speed**2 / diameter
        low, high = (speed, high) if pull < 9.81 else (low, speed)
    return low


def test_in_still_air_they_fall_at_the_terminal_speed_of_their_size():
    found = after(world(source={"end_s": 0.1}, lifetime=4.0, density=50.0, diameter=0.0005), 24)
    expected = [terminal_speed(diameter, 50.0) for diameter in found["diameter"]]
    assert len(expected) == 30
    np.testing.assert_allclose(-found["velocity"][:, 2], expected, rtol=2e-3)
    assert np.ptp(expected) > 0.1


def test_they_come_to_rest_on_the_floor_and_not_below_it():
    found = after(world(source={"end_s": 0.1}, lifetime=4.0, density=200.0, diameter=0.003), 60)
    assert not found["velocity"].any()
    assert found["position"][:, 2].min() == found["position"][:, 2].max() == 0.0


@pytest.mark.parametrize("grid", ["box", "window", "open"])
def test_outside_of_a_window_the_wind_goes_on(grid):
    """Air that leaves the box of a smoke is at rest, what a window of it leaves out is not."""
    found = after(
        world(
            smoke={"wind": (2.0, 0.0, 0.0), "grid": grid, "cell_size": 0.1},
            source={"end_s": 0.02, "position": (-0.4, 0.0, 0.5), "velocity": (2.0, 0.0, 0.0)},
            gravity=(0.0, 0.0, 0.0),
            domain={"min": (-0.5, -0.5, 0.0), "max": (3.5, 0.5, 1.0)},
            lifetime=4.0,
            density=10.0,
            diameter=0.0003,
        ),
        90,
    )
    assert found["velocity"][:, 0] == pytest.approx(2.0, abs=0.1)


def test_sides_that_are_open_to_the_smoke_let_them_out():
    """Although the domain, whose walls are for fluids, is closed there."""
    source = {"end_s": 0.1, "position": (0.4, 0.0, 0.5), "velocity": (3.0, 0.0, 1.0)}
    found = after(world(source=source, domain=HALL, lifetime=4.0, density=200.0, diameter=0.003), 30)
    assert found["position"][:, 0].min() > 0.6


def test_an_even_wind_carries_them_at_its_speed():
    found = after(
        world(
            smoke={"wind": (1.0, 0.0, 0.0)},
            source={"end_s": 0.02, "position": (-0.4, 0.0, 0.6)},
            lifetime=4.0,
            density=10.0,
            diameter=0.0003,
        ),
        24,
    )
    np.testing.assert_allclose(found["velocity"][:, 0], 1.0, rtol=0.01)
    assert np.abs(found["velocity"][:, 1]).max() < 0.01


def test_they_come_at_their_rate_from_inside_their_source_and_grow_cold():
    made = world(source={"start_s": 0.05, "end_s": 0.35}, lifetime=0.2, temperature=1200.0)
    counts, hottest, coldest = [], 0.0, 2000.0
    for _ in range(60):
        found = after(made, 1)
        counts.append(len(found["particle_id"]))
        assert (np.diff(found["particle_id"]) > 0).all()
        hottest = max(hottest, found["temperature"].max(initial=0.0))
        coldest = min(coldest, found["temperature"].min(initial=2000.0))
    assert counts[:3] == [0, 0, 0]
    assert counts[8] == pytest.approx(300.0 * (9 / FPS - 0.05), abs=1.0)  # none is cold before half the mean
    assert counts[-1] == 0
    assert 1190.0 < hottest <= 1200.0
    assert COLD_K <= coldest < COLD_K + 60.0
    assert made.solvers["sparks"].embers.number.to_numpy().max() == 89


def test_none_gives_its_place_to_another_before_it_is_cold():
    made = world(source={"rate": 3000.0}, lifetime=0.05)
    embers = made.solvers["sparks"].embers
    for _ in range(12):
        before = {name: getattr(embers, name).to_numpy() for name in ("number", "age", "life")}
        made.advance_frame()
        replaced = (embers.number.to_numpy() != before["number"]) & (before["number"] >= 0)
        assert (before["age"] >= before["life"])[replaced].all()
    assert replaced.any()


def test_a_source_without_an_inside_is_refused_at_the_start():
    with pytest.raises(ValueError, match="hardly any inside"):
        world(source={"shape": {"type": "torus", "major_radius": 0.2, "minor_radius": 0.0004}})


def test_bodies_and_the_floor_stop_them():
    plate = {
        "name": "plate",
        "kind": "static",
        "shape": {"type": "box", "size": (0.4, 1.2, 0.15)},
        "position": (-0.2, 0.0, 0.3),
    }
    found = after(
        world(rigid=(plate,), source={"shape": {"type": "box", "size": (0.6, 0.1, 0.05)}, "end_s": 0.1}, lifetime=4.0),
        80,
    )
    on_plate = (found["position"][:, 0] < -0.05) & (found["position"][:, 0] > -0.35)
    assert on_plate.any()
    assert (np.abs(found["position"][on_plate, 2] - 0.375) < 0.05).all()
    on_floor = found["position"][:, 0] > 0.05
    assert on_floor.any()
    assert (np.abs(found["position"][on_floor, 2]) < 0.05).all()
    assert np.abs(found["velocity"]).max() == 0.0


def test_a_killed_run_goes_on_with_the_same_bits():
    hot = {"source": ({"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.3), "temperature": 900.0},)}
    keys = {"smoke": hot, "source": {"spread": 0.5}, "lifetime": 0.3}
    undisturbed, killed, second = (world(**keys) for _ in range(3))
    expected = after(undisturbed, 20)
    after(killed, 9)
    second.restore(9, killed.checkpoint())
    found = after(second, 11)
    assert len(expected["particle_id"]) > 50
    assert digest_of(found) == digest_of(expected)


def test_embers_of_no_smoke_are_refused():
    with pytest.raises(ValueError, match='no smoke is named "air"; add') as refused:
        SceneParameters(
            embers=({"name": "sparks", "smoke": "air", "source": ({"shape": {"type": "sphere", "radius": 0.1}},)},)
        )
    assert isinstance(refused.value.errors()[0]["ctx"]["error"], KeyRefusedError)
