"""Fixed time steps that the speeds of a job are too high for."""

import math

import pytest
from checked_jobs import says

from pipeline.model.job import Job
from pipeline.run.checked_job import check_job
from sim.fluid.traits import TRAITS

WATER = {
    "name": "water",
    "particle_radius": 0.02,
    "block": [{"shape": {"type": "box", "size": (0.4, 0.4, 0.2)}, "position": (0.0, 0.0, 0.1)}],
}
DISC = {"shape": {"type": "disc", "radius": 0.1}, "direction": (0.0, 0.0, -1.0)}
BOX = {"name": "box", "shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "position": (0.0, 0.0, 0.5)}
FALL = math.sqrt(2.0 * 9.81 * math.sqrt(3.0))
"""Through the diagonal of the default domain, a cube of 1 m [m/s]."""
LIFTED = [{"time_s": 0.0, "position": (0.0, 0.0, 0.5)}, {"time_s": 0.1, "position": (0.0, 0.0, 2.5)}]
SPACING = 0.04


def stable_step(*bodies: dict, other_fluid: dict | None = None, **water: object) -> float:
    """The step that the warning of a fixed one of a second names."""
    fluids = [{**WATER, "dt": 1.0, **water}, *([{"dt": 1.0, **other_fluid}] if other_fluid else [])]
    job = Job.model_validate({"name": "a", "frames": 2, "fluid": fluids, "rigid": list(bodies)}, strict=False)
    (message,) = (each.message for each in check_job(job).warnings if each.path == ("fluid", 0, "dt"))
    return float(message.partition("about ")[2].partition(" s")[0])


def of_signals(speed: float) -> float:
    """Of WCSPH, whose speed of sound is ten times as large."""
    return 0.4 * SPACING / (11.0 * speed)


ROUNDING = 0.06
"""The message has two digits."""


def test_without_bodies_the_fall_through_the_domain_counts():
    assert stable_step() == pytest.approx(of_signals(FALL), rel=ROUNDING)


@pytest.mark.parametrize(
    ("motion", "speed"),
    [
        ({"kind": "dynamic", "density": 500.0, "velocity": (0.0, 30.0, 0.0)}, math.hypot(30.0, FALL)),
        # The corners are sqrt(3) 0.1 m from the centre.
        ({"kind": "dynamic", "density": 500.0, "angular_velocity": (0.0, 0.0, 200.0)}, FALL + 34.6),
        ({"kind": "kinematic", "velocity": (25.0, 0.0, 0.0)}, 25.0),
        ({"kind": "kinematic", "angular_velocity": (0.0, 0.0, 200.0)}, 34.6),
        ({"kind": "kinematic", "interpolation": "linear", "keyframe": LIFTED}, 20.0),
        ({"kind": "kinematic", "velocity": (1.0, 0.0, 0.0)}, FALL),
        ({}, FALL),
    ],
    ids=["thrown", "spinning", "moved", "turned", "keyframed", "slow", "static"],
)
def test_bodies_that_are_faster_than_the_fluid_shorten_the_step(motion, speed):
    assert stable_step({**BOX, **motion}) == pytest.approx(of_signals(speed), rel=ROUNDING)


def test_a_faster_fluid_in_the_same_tank_shortens_the_step():
    jet = {"name": "jet", "particle_radius": 0.02, "emitter": [{**DISC, "position": (0.0, 0.0, 0.9), "speed": 40.0}]}
    assert stable_step(other_fluid=jet) == pytest.approx(of_signals(math.hypot(40.0, FALL)), rel=ROUNDING)


@pytest.mark.parametrize("solver", ["dfsph", "pcisph"])
def test_implicit_solvers_have_no_speed_of_sound_but_a_limit_by_gravity(solver):
    share = TRAITS[solver].cfl_number
    assert stable_step(solver=solver) == pytest.approx(share * SPACING / FALL, rel=ROUNDING)
    thrown = {**BOX, "kind": "kinematic", "velocity": (25.0, 0.0, 0.0)}
    assert stable_step(thrown, solver=solver) == pytest.approx(share * SPACING / 25.0, rel=ROUNDING)
    by_gravity = TRAITS[solver].gravity_number * math.sqrt(SPACING / 9.81)
    assert stable_step(solver=solver, cfl=2.0) == pytest.approx(
        min(by_gravity, 2.0 * share * SPACING / FALL), rel=ROUNDING
    )


def impact_warnings(**water: object) -> list[str]:
    """What is said of a drop of water 2 cm apart on a ball."""
    ball = {"name": "ball", "shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.1)}
    drop = {"shape": {"type": "box", "size": (0.2, 0.2, 0.2)}, "position": (0.0, 0.0, 0.8)}
    fluid = {"name": "water", "particle_radius": 0.01, "block": [drop], "dt": 1.0e-4, **water}
    job = Job.model_validate({"name": "a", "frames": 2, "fluid": [fluid], "rigid": [ball]}, strict=False)
    return [each.message for each in check_job(job).warnings if each.path == ("fluid", 0, "dt")]


@pytest.mark.parametrize(
    "options", [{}, {"wall_friction": 1.0}, {"artificial_viscosity": 0.1}], ids=["neither", "friction", "viscosity"]
)
@pytest.mark.parametrize("sound", [45.0, 60.0])
def test_a_step_that_does_not_bear_an_impact_is_warned_of(sound, options):
    """As it diverged: 2 cm, 45 and 60 m/s and 1e-4 s, which the flow alone would bear."""
    bearing = 2.0 * 0.02 / (1.1 * sound * math.sqrt(28.0) * (1.0 + 1.9 * FALL / sound) ** 3)
    (message,) = impact_warnings(sound_speed=sound, **options)
    assert says(message, f"0.0001 s is above the {bearing:.2g} s ... wall_friction = 1 and artificial_viscosity = 0.1")


@pytest.mark.parametrize(
    "options",
    [
        {"sound_speed": 60.0, "wall_friction": 1.0, "artificial_viscosity": 0.1},
        {"sound_speed": 60.0, "dt": 6.8e-5},
        {"sound_speed": 60.0, "dt": "adaptive"},
        {"solver": "dfsph"},
        {"solver": "pcisph"},
    ],
    ids=["softened", "short", "adaptive", "dfsph", "pcisph"],
)
def test_a_step_that_bears_an_impact_passes_without_a_word(options):
    assert impact_warnings(**options) == []


def test_a_step_that_the_flow_does_not_bear_is_warned_of_once():
    (message,) = impact_warnings(sound_speed=60.0, dt=1.0e-3)
    assert "above the stable step" in message


def test_a_surface_that_is_stiffer_than_the_flow_is_told_with_what_the_flow_bears():
    def warnings(**water: object) -> list[str]:
        fluid = {**WATER, "solver": "dfsph", "surface_tension_model": "csf", **water}
        job = Job.model_validate({"name": "a", "frames": 2, "fluid": [fluid]}, strict=False)
        return [each.message for each in check_job(job).warnings if each.path == ("fluid", 0, "surface_tension")]

    assert warnings(surface_tension=0.072) == []  # a frame's steps are those of the flow
    (stiff,) = warnings(surface_tension=1.0e5)
    # Half of the root of rho d³/(2 pi sigma), d = 0.04 m.
    step = 0.5 * math.sqrt(1000.0 * 0.04**3 / (2.0 * math.pi * 1.0e5))
    assert float(stiff.partition("steps of ")[2].partition(" s")[0]) == pytest.approx(step, rel=ROUNDING)
    bearable = float(stiff.partition("use ")[2].partition(" or less")[0])
    assert warnings(surface_tension=bearable) == []
    assert warnings(surface_tension=1.3 * bearable)
    fixed = stable_step(solver="dfsph", surface_tension_model="csf", surface_tension=1.0e5)
    assert fixed == pytest.approx(step, rel=ROUNDING)


def test_a_dye_that_diffuses_in_no_time_is_told_with_what_is_bearable():
    def warnings(**water: object) -> list[str]:
        block = {**WATER["block"][0], "dye": 1.0}
        far = {**block, "position": (0.0, 0.0, 0.4), "dye": 0.0}
        fluid = {**WATER, "solver": "dfsph", "block": [block, far], **water}
        job = Job.model_validate({"name": "a", "frames": 2, "fluid": [fluid]}, strict=False)
        return [each.message for each in check_job(job).warnings if each.path == ("fluid", 0, "dye_diffusivity")]

    assert warnings(dye_diffusivity=1.0e-5) == []
    (fast,) = warnings(dye_diffusivity=10.0)
    bearable = float(fast.partition("use ")[2].partition(" m²/s")[0])
    assert warnings(dye_diffusivity=bearable) == []
    assert warnings(dye_diffusivity=1.3 * bearable)
