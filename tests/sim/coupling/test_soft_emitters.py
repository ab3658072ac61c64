"""Soft matter that is poured: how much, when, how it falls, and onto what."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from thread_counts import digest_of

from sim.build import build_world
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

SPOUT = {"shape": {"type": "disc", "radius": 0.04}, "position": (0.0, 0.0, 0.4), "direction": (0.0, 0.0, -1.0)}
FLOW = {"flow_rate": 0.002, "start_s": 0.05, "total_volume": 2.0e-4}


def world_of(*emitters: dict[str, Any], **tables: Any) -> Any:
    sand = {"name": "sand", "material": "sand", "young_modulus": 5.0e4, "cell_size": 0.02, "emitter": emitters}
    domain = {"min": (-0.15, -0.15, 0.0), "max": (0.15, 0.15, 0.5)}
    return build_world(
        SceneParameters.model_validate({"domain": domain, "soft": [sand], **tables}), frames_per_second=60
    )


def test_as_much_is_poured_as_flows_in_and_it_falls_freely():
    world = world_of(SPOUT | FLOW)
    soft = world.solvers["soft"]
    amounts = []
    for _ in range(12):
        world.advance_frame()
        amounts.append(soft.diagnostics()["mass"] / 1600.0)
    layer = np.sum(soft.poured.time_s == soft.poured.time_s[-1]) * 1.0e-6  # m³
    times = np.arange(1, 13) / 60.0
    due = np.clip(0.002 * (times - 0.05), 0.0, 2.0e-4)
    # What a layer brings comes at once, and the step that it comes in begins before a frame ends.
    np.testing.assert_allclose(amounts, due, atol=2.0 * layer)
    assert amounts[-1] == pytest.approx(2.0e-4, rel=1.0e-6)
    assert amounts[1] == 0.0
    # It falls freely: its layers only exchange momentum.
    assert np.linalg.norm(soft.poured.velocity[0]) == pytest.approx(0.002 / (np.pi * 0.04**2), rel=1.0e-5)
    age = times[-1] - soft.poured.time_s
    now = soft.view("sand")
    falling = soft.poured.velocity[:, 2] - 9.81 * age
    assert now["velocity"][:, 2].mean() == pytest.approx(falling.mean(), rel=0.01)
    fallen = soft.poured.position[:, 2] + soft.poured.velocity[:, 2] * age - 0.5 * 9.81 * age**2
    assert now["position"][:, 2].mean() == pytest.approx(fallen.mean(), abs=0.001)


def test_sand_poured_into_water_sinks_and_goes_on_to_the_bit():
    water = {"name": "water", "particle_radius": 0.015, "block": []}
    water["block"] = [{"shape": {"type": "box", "size": (0.3, 0.3, 0.12)}, "position": (0.0, 0.0, 0.06)}]
    pouring = SPOUT | FLOW | {"start_s": 0.0, "position": (0.0, 0.0, 0.2)}
    world = world_of(pouring, fluid=[water])
    for _ in range(4):
        world.advance_frame()
    assert 0 < world.solvers["soft"].diagnostics()["particle_count"] < len(world.solvers["soft"].owner)
    checkpoint = world.checkpoint()
    again = world_of(pouring, fluid=[water])
    again.restore(4, checkpoint)
    for each in (world, again):
        for _ in range(4):
            each.advance_frame()
    assert digest_of(again.checkpoint()) == digest_of(world.checkpoint())
    for _ in range(20):
        world.advance_frame()
    assert world.solvers["soft"].view("sand")["position"][:, 2].mean() < 0.06


def test_openings_that_are_too_narrow_or_without_an_end_are_refused():
    with pytest.raises(ValueError, match=r'soft "sand" emitter\[0\]: is too narrow for particles 0.01 m apart'):
        world_of(SPOUT | FLOW | {"shape": {"type": "disc", "radius": 0.003}})
    with pytest.raises(ValidationError, match="has neither end_s nor total_volume"):
        world_of(SPOUT | {"speed": 1.0})
    with pytest.raises(ValidationError, match="is for emitters of fluids"):
        world_of(SPOUT | FLOW | {"follow": "cart"})


def path_to(*place: float) -> list[dict[str, Any]]:
    return [{"time_s": 0.0, "position": (0.0, 0.0, 0.4)}, {"time_s": 0.5, "position": place}]


def test_openings_that_pour_outside_the_domain_or_in_a_solid_are_refused():
    moving = {key: SPOUT[key] for key in ("shape", "direction")} | {"speed": 0.5, "end_s": 0.6}
    for place in ((3.0, 0.0, 0.4), (0.0, 0.0, 3.0)):
        with pytest.raises(ValueError, match=r'soft "sand" emitter\[0\]: its keyframes take its opening out of'):
            world_of(moving | {"keyframe": path_to(*place)})
    world_of(moving | {"keyframe": path_to(3.0, 0.0, 0.4), "end_s": 0.05})  # it has ended by then
    with pytest.raises(ValueError, match="places of its opening are outside the domain"):
        world_of(SPOUT | FLOW | {"position": (0.0, 0.0, 0.6)})
    ball = {"name": "ball", "kind": "static", "shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.4)}
    with pytest.raises(ValueError, match="places of its opening are in a solid body"):
        world_of(SPOUT | FLOW, rigid=[ball])


def test_openings_at_one_place_and_time_are_refused():
    with pytest.raises(ValueError, match=r'emitter\[1\]: is the same opening as soft "sand" emitter\[0\], at the same'):
        world_of(SPOUT | FLOW, SPOUT | FLOW)
    first = SPOUT | {"speed": 0.5, "end_s": 0.1}
    world_of(first, SPOUT | {"speed": 1.0, "start_s": 0.1, "end_s": 0.2})
