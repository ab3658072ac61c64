"""Inflow over time: ramps, ends, and the layers and particles that they come to."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from sim.fluid.opening import Opening
from sim.fluid.parameters import EmitterParameters
from sim.shapes.inflow import Inflow

SPACING = 0.01
SPOUT = {"shape": {"type": "disc", "radius": 0.03}, "position": (0, 0, 0.4), "direction": (0, 0, -1)}


def opening(**keys: object) -> Opening:
    return Opening.of(EmitterParameters.model_validate({**SPOUT, **keys}), SPACING, SPACING**3)


@pytest.mark.parametrize(
    "strengths",
    [[], [(0.0, 0.0), (0.5, 1.0)], [(0.3, 0.2), (0.4, 1.0), (0.8, 0.0), (1.2, 0.0), (1.4, 0.5)], [(0.1, 0.7)]],
    ids=["steady", "ramp", "keyframes with a pause", "one point"],
)
def test_travel_is_the_integral_of_speed_and_time_of_travel_its_inverse(strengths):
    inflow = Inflow.of(2.0, strengths, 0.2, None, math.inf)
    times = np.linspace(0.0, 2.0, 20_001)
    given = np.array(strengths or [(0.0, 1.0)])
    speeds = np.where(times >= 0.2, 2.0 * np.interp(times, given[:, 0], given[:, 1]), 0.0)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (speeds[1:] + speeds[:-1]) * np.diff(times))])
    for k in range(0, len(times), 500):
        assert inflow.travel_at(times[k]) == pytest.approx(integral[k], abs=2e-4)  # the jump at the start
        if speeds[k] > 0.0:
            assert inflow.time_of(inflow.travel_at(times[k])) == pytest.approx(max(times[k], 0.2), abs=1e-9)


@pytest.mark.parametrize(
    "keys",
    [
        {"speed": 1.0, "end_s": 0.777},
        {"flow_rate": 0.001, "total_volume": 0.00034567},
        {
            "flow_rate": 0.001,
            "total_volume": 0.0002,
            "ramp": [{"time_s": 0.0, "strength": 0.0}, {"time_s": 0.3, "strength": 1.0}],
        },
        {"speed": 2.0, "end_s": 0.9, "ramp": [{"time_s": 0.2, "strength": 1.0}, {"time_s": 0.9, "strength": 0.0}]},
        {"speed": 1.0, "total_volume": 0.00002},
    ],
    ids=["time", "amount", "ramp to an amount", "ramp down", "less than a layer"],
)
def test_the_amount_is_right_to_a_layer_at_any_time_and_to_a_particle_at_the_end(keys):
    emitter = EmitterParameters.model_validate({**SPOUT, **keys})
    own = opening(**keys)
    for time_s in np.linspace(0.0, 1.0, 101):
        meant = emitter.emitted_volume(time_s) / SPACING**3
        assert -len(own.places) - 1.0 < own.particles_due(time_s) - meant <= 0.5 + 1e-6
    total = keys.get("total_volume", emitter.emitted_volume(10.0))
    assert own.particles_due(own.end_s) == own.total_particles == pytest.approx(total / SPACING**3, abs=0.5)
    left = [own.leaves_at(layer) for layer in range(own.layers_due(10.0))]
    assert left == sorted(left)
    assert left[-1] == pytest.approx(own.end_s, rel=0.02)
    assert sum(len(own.places_of(layer)) for layer in range(len(left))) == own.total_particles
    for layer, time_s in enumerate(left):
        assert own.layers_due(time_s + 1e-9) == layer + 1


@pytest.mark.parametrize(
    ("points", "dry_s"),
    [
        ([(0.0, 1.0), (0.5, 0.0)], 0.5),
        ([(0.1, 0.3), (0.3, 0.7), (0.4, 0.0), (2.0, 0.0)], 0.4),
        ([(0.0, 0.0)], 0.0),
    ],
)
def test_an_inflow_that_runs_dry_has_ended(points, dry_s):
    """Every particle has come out then: none waits for more."""
    ramp = [{"time_s": time_s, "strength": strength} for time_s, strength in points]
    for speed in np.linspace(0.3, 1.7, 15):
        keys = {"speed": float(speed), "ramp": ramp}
        emitter, own = EmitterParameters.model_validate({**SPOUT, **keys}), opening(**keys)
        volume = emitter.emitted_volume(math.inf)
        assert own.end_s == dry_s
        assert own.particles_due(own.end_s) == own.total_particles == pytest.approx(volume / SPACING**3, abs=0.5)


def test_a_flow_rate_is_a_speed_by_the_area():
    emitter = EmitterParameters.model_validate({**SPOUT, "flow_rate": 0.001})
    assert emitter.inflow_speed == pytest.approx(0.001 / (math.pi * 0.03**2))
    own = opening(flow_rate=0.001)
    assert len(own.places) * SPACING**3 * own.speed / own.layer_distance == pytest.approx(0.001, rel=1e-12)


@pytest.mark.parametrize(
    ("shape", "area"),
    [
        ({"type": "sphere", "radius": 0.03}, math.pi * 0.03**2),
        ({"type": "cylinder", "radius": 0.03, "height": 0.2}, math.pi * 0.03**2),
        ({"type": "box", "size": (0.05, 0.08, 0.3)}, 0.05 * 0.08),
        ({"type": "torus", "major_radius": 0.06, "minor_radius": 0.02}, math.pi * (0.08**2 - 0.04**2)),
        ({"type": "duck", "length": 0.2}, None),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else "",
)
def test_any_shape_has_an_opening_whose_cells_fill_it(shape, area):
    emitter = EmitterParameters.model_validate({**SPOUT, "shape": shape, "speed": 1.0})
    if area is not None:
        assert emitter.area == pytest.approx(area, rel=2e-3)
    own = opening(shape=shape, speed=1.0)
    assert 0.82 * SPACING <= own.layer_distance <= 1.35 * SPACING
    assert len(own.places) * SPACING**3 / own.layer_distance == pytest.approx(emitter.area, rel=1e-9)
    if shape["type"] == "torus":
        assert np.hypot(*own.places.T).min() > 0.04
        assert np.hypot(*own.places.T).max() < 0.08


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({}, "has neither speed nor flow_rate; add one of them"),
        ({"speed": 1.0, "flow_rate": 1.0}, "has both speed and flow_rate; remove one, as the flow is speed times area"),
        ({"speed": -1.0}, "greater than 0"),
        ({"flow_rate": 0.0}, "greater than 0"),
        ({"speed": 1.0, "ramp": [{"time_s": 0.0, "strength": -0.5}]}, "greater than or equal to 0"),
        (
            {"speed": 1.0, "ramp": [{"time_s": 1.0, "strength": 1.0}, {"time_s": 1.0, "strength": 0.0}]},
            r"ramp\[1\].time_s must be after 1 s, that of the point before, got 1 s",
        ),
        ({"speed": 1.0, "interpolation": "linear"}, "interpolation has no meaning without keyframes"),
        ({"speed": 1.0, "follow": "a", "keyframe": [{"time_s": 0.0, "position": (0, 0, 0.4)}]}, "has keyframes"),
    ],
)
def test_what_an_emitter_cannot_mean_is_refused(keys, reason):
    with pytest.raises(ValidationError, match=reason):
        EmitterParameters.model_validate({**SPOUT, **keys})
