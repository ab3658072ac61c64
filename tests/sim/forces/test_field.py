import math

import numpy as np
import pytest
import taichi as ti

from sim.core.arrays import Vectors, on_device
from sim.core.launch import kernel
from sim.forces.field import ForceField, ForceTable, acceleration_at, air_at
from sim.scene import SceneParameters

pytestmark = pytest.mark.usefixtures("taichi_cpu")

BALL = {"name": "ball", "kind": "dynamic", "density": 500.0, "shape": {"type": "sphere", "radius": 0.1}}


@kernel
def sample(forces: ForceTable, places: Vectors, accelerations: Vectors, winds: Vectors):
    for i in range(places.shape[0]):
        x = places[i]
        accelerations[i] = acceleration_at(forces, 0, x, True) + acceleration_at(forces, 0, x, False)
        winds[i] = air_at(forces, 0, x).xyz


def field_of(*forces: dict) -> ForceField:
    return ForceField(SceneParameters.model_validate({"force": forces, "rigid": [BALL]}).force)


def looked_up(field: ForceField, places: np.ndarray, time_s: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations and velocities of the air at places, (n, 3) each."""
    field.at(time_s)
    found = [ti.Vector.ndarray(3, ti.f32, len(places)) for _ in range(2)]
    sample(field.on([("ball",)]).now, on_device(np.asarray(places, np.float32)), *found)
    accelerations, winds = (each.to_numpy().astype(np.float64) for each in found)
    return accelerations, winds


def test_an_attractor_is_strongest_at_its_radius_and_falls_by_its_power():
    field = field_of(
        {"type": "attractor", "position": (1.0, 0.0, 0.0), "acceleration": 8.0, "radius": 0.5, "falloff": 2.0}
    )
    found, _ = looked_up(field, [(1.0, 0.25, 0.0), (1.5, 0.0, 0.0), (1.0, 0.0, -1.0), (1.0, 0.0, 0.0)])
    expected = [(0.0, -4.0, 0.0), (-8.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.0, 0.0)]
    assert found == pytest.approx(np.array(expected), abs=1e-6)


def test_a_line_attracts_across_itself_and_pushes_where_it_is_negative():
    line = {"type": "attractor", "position": (0.0, 0.0, 5.0), "direction": (0.0, 0.0, 2.0), "radius": 0.1}
    found, _ = looked_up(field_of(line | {"acceleration": -3.0, "falloff": 1.0}), [(0.2, 0.0, -4.0)])
    assert found == pytest.approx(np.array([(1.5, 0.0, 0.0)]), abs=1e-6)


def test_a_vortex_turns_as_a_solid_inside_and_keeps_its_circulation_outside():
    vortex = {"type": "vortex", "position": (0.0, 0.0, 1.0), "speed": 6.0, "radius": 0.5}
    _, found = looked_up(field_of(vortex), [(0.25, 0.0, 9.0), (0.0, 0.5, 0.0), (-2.0, 0.0, 0.0)])
    assert found == pytest.approx(np.array([(0.0, 3.0, 0.0), (-6.0, 0.0, 0.0), (0.0, -1.5, 0.0)]), abs=1e-5)


def test_gusts_keep_the_mean_stay_within_their_part_and_travel_with_the_wind():
    wind = {"type": "wind", "velocity": (0.0, 4.0, 0.0), "gusts": 0.5, "gust_s": 0.25, "seed": 3}
    field = field_of(wind)
    speeds = np.array([looked_up(field, [(0.0, 0.0, 0.0)], time)[1][0, 1] for time in np.arange(0.0, 100.0, 0.05)])
    assert 2.0 <= speeds.min() < 2.2
    assert 5.8 < speeds.max() <= 6.0
    assert speeds.mean() == pytest.approx(4.0, rel=0.02)
    later = looked_up(field, [(0.0, 2.0, 7.0)], 10.5)[1]  # half a second downwind
    assert later == pytest.approx(looked_up(field, [(0.0, 0.0, 0.0)], 10.0)[1], rel=1e-4)


def test_turbulence_has_the_speed_it_is_given_and_no_divergence():
    field = field_of({"type": "turbulence", "speed": 2.0, "size": 0.5, "seed": 7})
    random = np.random.default_rng(0)
    places = random.uniform(-50.0, 50.0, (200_000, 3))
    _, winds = looked_up(field, places)
    assert math.sqrt((winds**2).sum(axis=1).mean()) == pytest.approx(2.0, rel=0.01)
    assert np.abs(winds.mean(axis=0)).max() < 0.02
    near, step = random.uniform(-1.0, 1.0, (1000, 3)), 2e-3
    slopes = []
    for axis in range(3):
        ends = [looked_up(field, near + side * step * np.eye(3)[axis])[1] for side in (-1, 1)]
        slopes.append((ends[1] - ends[0]) / (2.0 * step))
    gradient = np.stack(slopes, axis=2)
    divergence = np.trace(gradient, axis1=1, axis2=2)
    assert math.sqrt((divergence**2).mean()) < 1e-3 * math.sqrt((gradient**2).mean())
    assert looked_up(field, near, 5.0)[1] != pytest.approx(looked_up(field, near, 0.0)[1], abs=0.1)


@pytest.mark.parametrize(
    ("shape", "inside", "halfway", "outside"),
    [
        ({"type": "box", "size": (2.0, 1.0, 1.0)}, (0.0, 0.0, 0.7), (0.0, 0.0, 0.9), (0.7, 0.0, 0.0)),
        ({"type": "sphere", "radius": 1.0}, (0.0, 0.7, 0.0), (0.0, 0.9, 0.0), (0.8, 0.8, 0.0)),
        ({"type": "cylinder", "radius": 0.5, "height": 2.0}, (0.7, 0.0, 0.0), (0.9, 0.0, 0.0), (0.0, 0.0, 0.7)),
    ],
)
def test_a_region_limits_a_force_and_fades_at_its_edge(shape, inside, halfway, outside):
    """The box and the cylinder are turned: their long side is along z and x."""
    turn = (0.0, 90.0, 0.0)
    within = {"shape": shape, "rotation_deg": turn, "edge": 0.2, "position": (3.0, 0.0, 0.0)}
    field = field_of({"type": "gravity", "acceleration": (0.0, 0.0, 2.0), "within": within})
    found, _ = looked_up(field, np.add([inside, halfway, outside], (3.0, 0.0, 0.0)))
    assert found[:, 2] == pytest.approx([2.0, 1.0, 0.0], abs=1e-5)


def test_times_and_ramps_set_the_strength():
    ramp = [{"time_s": 1.0, "strength": 0.0}, {"time_s": 2.0, "strength": 1.0}]
    force = {"type": "gravity", "acceleration": (1.0, 0.0, 0.0), "start_s": 1.2, "end_s": 3.0, "ramp": ramp}
    field = field_of(force)
    found = [looked_up(field, [(0.0, 0.0, 0.0)], time)[0][0, 0] for time in (1.1, 1.25, 2.5, 3.0)]
    assert found == pytest.approx([0.0, 0.25, 1.0, 0.0])


def test_a_force_acts_on_what_it_names_alone():
    field = field_of({"type": "gravity", "acceleration": (1.0, 0.0, 0.0), "only": ("ball",)})
    assert field.on([("ball", "balls")]).accelerates
    assert field.on([("stone", "stones")]).accelerates is False
