"""Sources that move, flicker and ramp, and those of any shape."""

import numpy as np
import pytest
import trimesh
from smoke_scenes import air_in

from sim.core.domain import DomainParameters
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.smoke.grid import SmokeGrid
from sim.smoke.parameters import SmokeParameters, SmokeSourceParameters
from sim.smoke.sources import Source

pytestmark = pytest.mark.usefixtures("taichi_cpu")

DOMAIN = DomainParameters(min=(0.0, 0.0, 0.0), max=(2.2, 0.8, 0.8))
CELL = 0.05
RADIUS = 0.25
START, END = (0.4, 0.4, 0.4), (1.65, 0.4, 0.4)
BALL = {"type": "sphere", "radius": RADIUS}
MOVING = {
    "shape": BALL,
    "temperature": 293.0,
    "keyframe": [{"time_s": 0.0, "position": START}, {"time_s": 1.0, "position": END}],
    "interpolation": "linear",
}


class Emission:
    """A source in air that nothing moves, without the solver around it."""

    def __init__(self, source: dict) -> None:
        self.grid = SmokeGrid.build(SmokeParameters(name="trail", cell_size=CELL, source=[source]), DOMAIN)
        self.air = air_in(self.grid)
        self.arrays = [*self.air.state.velocity, self.air.state.density, self.air.state.excess]
        self.source = Source(SmokeSourceParameters(**source), cell_size=CELL, ambient_temperature=293.0)
        self.source.enter(self.grid)
        self.emitted = 0.0

    def run(self, steps: int, begin_s: float = 0.0, end_s: float = 1.0) -> np.ndarray:
        """Emit in so many steps; the density, (nx, ny, nz)."""
        dt = (end_s - begin_s) / steps
        for time_s in begin_s + dt * np.arange(steps):
            if self.source.parameters.emits_during(time_s, time_s + dt):
                self.emitted += self.source.emit(self.air, float(time_s), dt)
        return self.cells(3)

    def clear(self) -> None:
        for array in self.arrays:
            array.fill(0.0)

    def cells(self, number: int) -> np.ndarray:
        return self.grid.trim(self.arrays[number].to_numpy(), self.grid.cells)

    def faces(self, axis: int) -> np.ndarray:
        return self.grid.trim(self.arrays[axis].to_numpy(), self.grid.face_shape(axis))


def test_a_moving_source_leaves_its_swept_volume_behind_whatever_the_steps():
    # A ball that goes 1.25 m in a second, a quarter of a cell in a step, or 25 cells in one.
    emission = Emission(MOVING)
    trails = []
    for steps in (100, 7, 1):
        emission.clear()
        emission.emitted = 0.0
        trails.append(emission.run(steps))
        # What is added is counted, and stays.
        assert emission.emitted == pytest.approx(trails[-1].sum(), rel=1e-6)
    swept = 4.0 / 3.0 * np.pi * RADIUS**3 + np.pi * RADIUS**2 * (END[0] - START[0])
    for trail in trails:
        assert trail.sum() * CELL**3 == pytest.approx(swept, rel=0.005)
        assert trail.max() == 1.0
        assert np.array_equal(trail == 1.0, trails[0] == 1.0)
        # At the sides a cell is covered by half of the ball in one step and by the other half in the next.
        assert trail == pytest.approx(trails[0], abs=0.05)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("cells", [1.5, 2.3])
def test_a_small_ball_emits_its_volume_wherever_it_lies_between_cells(cells, moves):
    # By whole cells a ball of a cell and a half of radius was up to 43 % off.
    random, radius = np.random.default_rng(2), cells * CELL
    for _ in range(5):
        place = tuple(np.array([1.0, 0.4, 0.4]) + CELL * random.random(3))
        path = [{"time_s": time, "position": place} for time in (0.0, 1.0)]
        source = {"shape": {"type": "sphere", "radius": radius}, "position": place, "fluctuation": 0.0, "density": 0.5}
        emission = Emission({**source, "temperature": 393.0, **({"keyframe": path} if moves else {})})
        density = emission.run(3)
        assert emission.emitted == pytest.approx(density.sum(), rel=1e-6)
        assert density.sum() * CELL**3 == pytest.approx(0.5 * 4.0 / 3.0 * np.pi * radius**3, rel=0.01)
        assert emission.cells(4) == pytest.approx(200.0 * density, rel=1e-6)


def test_a_moving_source_emits_only_while_it_emits():
    trail = Emission({**MOVING, "start_s": 0.4, "end_s": 0.6}).run(3)
    x = np.flatnonzero(trail.any(axis=(1, 2))) * CELL + 0.5 * CELL
    way = END[0] - START[0]
    # From where it was at 0.4 s to where it was at 0.6 s, in steps of a third of a second.
    assert x[0] == pytest.approx(START[0] + 0.4 * way - RADIUS, abs=CELL)
    assert x[-1] == pytest.approx(START[0] + 0.6 * way + RADIUS, abs=CELL)


def test_a_turning_source_sweeps_a_disc():
    arm = {"type": "box", "size": (0.6, 0.1, 0.15)}
    middle = (1.0, 0.4, 0.375)
    turn = [{"time_s": time, "position": middle, "rotation_deg": (0.0, 0.0, 180.0 * time)} for time in (0.0, 0.5, 1.0)]
    trail = Emission({"shape": arm, "temperature": 293.0, "keyframe": turn, "interpolation": "linear"}).run(2)
    # Half a turn covers the disc of its half diagonal.
    disc = np.pi * (0.3**2 + 0.05**2) * 0.15
    assert trail.sum() * CELL**3 == pytest.approx(disc, rel=0.01)


def test_velocity_of_a_moving_source_is_on_top_of_its_motion_and_turns_with_it():
    keyframes = [
        {"time_s": 0.0, "position": START, "rotation_deg": (0.0, 0.0, 30.0)},
        {"time_s": 1.0, "position": END, "rotation_deg": (0.0, 0.0, 120.0)},
    ]
    emission = Emission({**MOVING, "keyframe": keyframes, "velocity": (3.0, 0.0, 0.0)})
    emission.source.emit(emission.air, 0.499999, 1.0e-6)
    middle = np.array([0.5 * (START[0] + END[0]), *START[1:]])
    spin = 0.5 * np.pi
    for axis, expected in ((0, 1.25 + 3.0 * np.cos(0.25 * np.pi)), (1, 3.0 * np.sin(0.25 * np.pi)), (2, 0.0)):
        arm = emission.grid.face_centres(axis).reshape(*emission.grid.face_shape(axis), 3) - middle
        turning = np.stack([-spin * arm[..., 1], spin * arm[..., 0], np.zeros(arm.shape[:3])])[axis]
        whole = np.linalg.norm(arm, axis=-1) < RADIUS - 0.87 * CELL
        assert whole.sum() > 200
        # Turned by 45 degrees since its start, at 1.25 m/s along x, and turning itself; in single precision.
        found = emission.faces(axis)
        assert found[whole] == pytest.approx((expected + turning)[whole], abs=1.0e-5)
        # Others have a part of it, by their part of the ball; turning adds nothing to the sum.
        assert found.sum() * CELL**3 == pytest.approx(expected * 4.0 / 3.0 * np.pi * RADIUS**3, rel=0.005)
        assert (np.abs(found) < np.abs(expected + turning) + 1.0e-5).all()
    assert emission.source.speed >= 3.0 + 1.25


def test_what_a_step_emits_depends_on_its_time_alone():
    # So a run that continues emits the same.
    source = {**MOVING, "temperature": 400.0, "velocity": (0.0, 0.5, 0.5), "flicker": 0.5, "seed": 3}
    whole, resumed = Emission(source), Emission(source)
    whole.run(4)
    whole.clear()
    whole.run(4, 0.5, 1.0)
    resumed.run(4, 0.5, 1.0)
    for mine, other in zip(resumed.arrays, whole.arrays, strict=True):
        assert mine.to_numpy().any()
        assert np.array_equal(mine.to_numpy(), other.to_numpy())


def test_strength_follows_the_ramp_and_its_largest_value_in_a_step_counts():
    ramp = [{"time_s": 0.2, "strength": 0.0}, {"time_s": 0.6, "strength": 0.8}, {"time_s": 1.0, "strength": 0.4}]
    source = {"shape": BALL, "position": START, "temperature": 393.0, "fluctuation": 0.0, "ramp": ramp}
    emission = Emission(source)
    for steps in (1, 5, 40):
        emission.clear()
        # In air at rest what was emitted stays: the crest of the ramp, which no step misses.
        assert emission.run(steps).max() == pytest.approx(0.8, rel=1e-6)
        assert emission.cells(4).max() == pytest.approx(0.8 * 100.0, rel=1e-6)
    for end_s, strength in ((0.4, 0.4), (0.2, 0.0)):
        emission.clear()
        assert emission.run(2, 0.0, end_s).max() == pytest.approx(strength, rel=1e-6)


def test_flicker_stays_within_its_bounds_and_is_a_function_of_time_and_seed():
    def strengths(seed: int) -> np.ndarray:
        flickering = {"shape": BALL, "position": START, "flicker": 0.6, "flicker_rate": 10.0, "seed": seed}
        source = Emission(flickering).source
        return np.array([source._steadiness(time) for time in np.linspace(0.0, 20.0, 2001)])

    first, again, other = strengths(1), strengths(1), strengths(2)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert 0.4 < first.min() < 0.45
    assert 0.95 < first.max() <= 1.0
    # Uniform numbers have a mean of a half; 200 of them have one with a standard error of 0.02.
    assert first.mean() == pytest.approx(1.0 - 0.6 * 0.5, abs=0.6 * 0.08)
    # Cosine between values 0.1 s apart: no faster than pi/2 times the largest difference over that time.
    assert np.abs(np.diff(first)).max() <= 0.6 * 0.5 * np.pi * 0.01 / 0.1 + 1e-12


def test_heat_fluctuates_otherwise_for_another_seed():
    fields = []
    for seed in (0, 0, 1):
        emission = Emission({"shape": BALL, "position": START, "seed": seed})
        emission.run(1, 0.0, 1.0 / 60.0)
        fields.append(emission.cells(4))
    assert np.array_equal(fields[0], fields[1])
    assert not np.array_equal(fields[0], fields[2])


@pytest.mark.parametrize("moves", [False, True])
def test_a_mesh_source_turned_and_scaled_fills_what_its_shape_does(tmp_path, moves):
    wedge = trimesh.convex.convex_hull(
        np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0, 0, 0.25], [0.3, 0.2, 0.0]], dtype=float)
    )
    file = tmp_path / "wedge.obj"
    wedge.export(file)
    placement = {
        "shape": {"type": "mesh", "file": str(file), "size": 0.4},
        "position": (1.0, 0.4, 0.35),
        "rotation_deg": (20.0, -35.0, 50.0),
        "scale": 1.5,
    }
    pose = {key: placement[key] for key in ("position", "rotation_deg")}
    path = {"keyframe": [{"time_s": 0.0, **pose}, {"time_s": 1.0, **pose}]} if moves else {}
    emission = Emission({**placement, "temperature": 293.0, **path})
    density = emission.run(1)
    solid = build_solid(Placement(**placement))
    distance = solid.signed_distance(emission.grid.cell_centres()).reshape(emission.grid.cells)
    # Looked up at half a cell's distance, edges and corners are rounded off by half the diagonal of that at most.
    margin = 0.87 * CELL * 1.5
    assert (density[distance < -margin] == 1.0).all()
    assert not density[distance >= margin + 0.13 * CELL].any()
    assert density.sum() * CELL**3 == pytest.approx(solid.volume, rel=0.02)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"follow": "duck"}, 'it follows "duck" and has keyframes; remove one of them'),
        ({"keyframe": [], "interpolation": "linear"}, "interpolation has no meaning without keyframes"),
        ({"position": (1.0, 0.0, 0.0)}, "position differs from that of the first keyframe, which places the source"),
        ({"keyframe": MOVING["keyframe"][::-1]}, r"keyframe\[1\].time_s must be after 1 s"),
        ({"ramp": [{"time_s": 1.0, "strength": 1.0}] * 2}, r"ramp\[1\].time_s must be after 1 s"),
        ({"flicker_rate": 3.0}, "flicker_rate has no meaning without flicker"),
    ],
)
def test_a_source_that_contradicts_itself_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        SmokeSourceParameters(**{**MOVING, **changes})
