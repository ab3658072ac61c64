"""The library: the same frames as a submitted job, arrays without copies, forces that do what forces do, refusals."""

import numpy as np
import pytest

from pipeline import Scene, make_job, read_frame, read_job, submit
from pipeline.base.errors import JobFileError, PipelineError
from pipeline.job.loading import LoadedJob

WATER = {
    "name": "water",
    "particle_radius": 0.03,
    "block": [{"shape": {"type": "box", "size": [0.24, 0.24, 0.24]}, "position": [-0.2, 0.0, 0.6]}],
}
SHEET = {
    "name": "sheet",
    "shape": {"type": "rectangle", "size": [0.4, 0.4], "counts": [9, 9]},
    "position": [0.5, 0.0, 0.5],
}
BALL = {
    "name": "ball",
    "kind": "dynamic",
    "shape": {"type": "sphere", "radius": 0.05},
    "density": 600.0,
    "position": [0.5, 0.0, 1.5],
}
PLUME = {
    "name": "plume",
    "cell_size": 0.1,
    "source": [{"shape": {"type": "sphere", "radius": 0.15}, "position": [-0.7, 0.0, 0.3]}],
}
DOMAIN = {"min": [-1.0, -0.5, 0.0], "max": [1.0, 0.5, 2.0]}


def job_of(**tables: object) -> LoadedJob:
    return make_job(**{"name": "tried", "device": "cpu", "domain": DOMAIN, "frames": 4, **tables})


@pytest.mark.slow
def test_frames_of_a_scene_are_those_of_the_submitted_job_to_the_bit(tmp_path):
    job = job_of(fluid=[WATER], cloth=[SHEET], rigid=[BALL], smoke=[PLUME])
    done = submit(job, output=tmp_path / "renders", until=["simulate"]).wait()
    scene = Scene(job)
    scene.write(tmp_path / "0.h5")
    for report in scene.frames():
        scene.write(tmp_path / f"{report.frame}.h5")
    assert scene.frame == 3
    for frame in range(4):
        cached = done.folder / "cache" / f"{frame:06d}.h5"
        assert (tmp_path / f"{frame}.h5").read_bytes() == cached.read_bytes()
    now = scene.bodies()["water"].arrays["position"]
    np.testing.assert_array_equal(done.frame(3).bodies["water"].arrays["position"], now)
    np.testing.assert_array_equal(read_frame(tmp_path / "3.h5").bodies["water"].arrays["position"], now)


def test_job_in_python_is_the_job_of_a_file_with_the_same_keys(tmp_path):
    path = tmp_path / "tried.toml"
    path.write_text(
        'name = "tried"\nduration = 0.5\n[domain]\nmin = [-1, -0.5, 0]\nmax = [1, 0.5, 2]\n'
        '[[rigid]]\nname = "ball"\nshape = { type = "sphere", radius = 0.05 }\nposition = [0.5, 0.0, 1.5]\n'
        '[material.ball]\nlook = "rubber"\n'
    )
    ball = {
        "shape": {"type": "sphere", "radius": np.float64(0.05)},
        "name": "ball",
        "position": np.array([0.5, 0, 1.5]),
    }
    domain = {name: tuple(corner) for name, corner in DOMAIN.items()}
    made = make_job(
        material={"ball": {"look": "rubber"}}, rigid=[ball], name="tried", domain=domain, duration=0.5, frames=None
    )
    assert made.job == read_job(path).job
    assert read_job(path, "duration=0.25").job.frame_count == 15


def test_every_problem_of_a_job_in_python_is_told_by_its_key():
    with pytest.raises(JobFileError) as refused:
        make_job(name="tried", frames=0, fluid=[{"name": "water", "viscosty": 1.0}])
    assert {line.split(":")[0] for line in refused.value.problems} == {
        "make_job frames",
        "make_job fluid[0].viscosty",
    }
    with pytest.raises(JobFileError, match="no job file can hold"):
        make_job(name=print)


def test_file_that_names_a_program_is_refused_unless_the_caller_names_it(tmp_path):
    path = tmp_path / "tried.toml"
    path.write_text('name = "tried"\n[render]\nblender = "/opt/blender"\n')
    with pytest.raises(JobFileError, match="may not choose what runs here"):
        read_job(path)
    assert read_job(path, "render.blender='/opt/blender'").job.render.blender == "/opt/blender"


def test_views_are_the_solvers_own_memory_and_cannot_be_written_to():
    scene = Scene(job_of(fluid=[WATER], cloth=[SHEET], smoke=[PLUME]))
    scene.step()
    for body, name in (("water", "position"), ("water", "velocity"), ("sheet", "position"), ("plume", "density")):
        array = scene.view(body)[name]
        assert np.shares_memory(array, scene.view(body)[name])
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
    water, seen = scene.bodies()["water"].arrays, scene.view("water")
    np.testing.assert_array_equal(seen["position"][np.argsort(seen["particle_id"])], water["position"])
    np.testing.assert_array_equal(scene.view("sheet")["velocity"], scene.bodies()["sheet"].arrays["velocity"])


def test_a_view_outlives_its_scene():
    positions = Scene(job_of(fluid=[WATER])).view("water")["position"]
    assert np.ptp(positions, axis=0) == pytest.approx([0.18, 0.18, 0.18], abs=1e-6)


@pytest.mark.parametrize(("kind", "body"), [("fluid", WATER), ("cloth", SHEET), ("rigid", BALL)])
def test_a_force_like_gravity_lets_bodies_fall_as_gravity_does(kind, body):
    vacuum = {"air_density": 0.0} if kind == "cloth" else {}
    pulled = Scene(job_of(gravity=[0, 0, 0], **{kind: [{**body, **vacuum}]}))
    pulled.add_force(body["name"], [0.0, 0.0, -4.0])
    pulled.add_force(body["name"], lambda arrays, _time: np.full_like(arrays["velocity"], [1.0, 0.0, -2.0]))
    for _ in pulled.frames(3):
        pass
    arrays = pulled.bodies()[body["name"]].arrays
    velocity = np.atleast_2d(arrays["velocity"]).mean(axis=0)
    # Impulses add up exactly; positions of float32 give velocities of cloth to some 1e-5.
    assert velocity == pytest.approx(np.array([1.0, 0.0, -6.0]) * pulled.time_s, abs=1e-4)


def test_a_central_force_swings_a_ball_at_its_frequency():
    ball = {**BALL, "position": [0.2, 0.0, 1.0]}
    scene = Scene(job_of(gravity=[0, 0, 0], rigid=[ball]))
    scene.add_force("ball", lambda arrays, _time: 25.0 * (np.array([0.0, 0.0, 1.0]) - arrays["position"]))
    xs = [scene.view("ball")["position"][0] for _ in scene.frames(60)]
    times = np.arange(1, 61) / 60
    # Of first order in the step of at most 2 ms: a phase of omega dt/2 = 0.005, of an amplitude of 0.2 m.
    np.testing.assert_allclose(xs, 0.2 * np.cos(5.0 * times), atol=0.002)


def test_a_force_acts_on_the_particles_it_is_meant_for_in_one_fluid_of_two():
    oil = {**WATER, "name": "oil", "block": [{**WATER["block"][0], "position": [0.4, 0.0, 0.6]}], "rest_density": 900.0}
    scene = Scene(job_of(gravity=[0, 0, 0], fluid=[WATER, oil]))
    scene.add_force("oil", lambda arrays, _time: np.where(arrays["position"][:, :1] > 0.4, [0.0, 3.0, 0.0], 0.0))
    scene.step()
    before, bodies = Scene(job_of(gravity=[0, 0, 0], fluid=[WATER, oil])).bodies()["oil"], scene.bodies()
    is_right = before.arrays["position"][:, 0] > 0.4
    speed = bodies["oil"].arrays["velocity"][:, 1]
    assert speed[is_right].mean() > 0.02 > abs(speed[~is_right]).max()
    assert abs(bodies["water"].arrays["velocity"]).max() < 1e-3


def test_pins_hold_nodes_against_a_force():
    pinned = {**SHEET, "pin": [{"corner": "x-y-"}]}
    scene = Scene(job_of(gravity=[0, 0, 0], cloth=[pinned]))
    start = scene.bodies()["sheet"].arrays["position"]
    scene.add_force("sheet", [0.0, 0.0, 20.0])
    for _ in scene.frames(3):
        pass
    moved = np.linalg.norm(scene.bodies()["sheet"].arrays["position"] - start, axis=1)
    assert (moved == 0.0).sum() == 1
    assert np.median(moved) > 0.01


def test_what_no_force_moves_is_refused_with_its_reason():
    post = {"name": "post", "shape": {"type": "box", "size": [0.1, 0.1, 0.1]}, "position": [0.0, 0.0, 0.1]}
    led = {key: value for key, value in BALL.items() if key != "density"}
    led |= {"name": "led", "kind": "kinematic", "velocity": [0.1, 0.0, 0.0]}
    scene = Scene(job_of(rigid=[post, led, {**BALL, "position": [0.0, 0.3, 1.0]}], smoke=[PLUME]))
    for body, reason in (
        ("post", "stands still"),
        ("led", "kinematic"),
        ("plume", "takes no forces"),
        ("bal", 'no body is named "bal"; did you mean "ball"'),
    ):
        with pytest.raises(ValueError, match=reason):
            scene.add_force(body, [0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="shape"):
        scene.add_force("ball", [0.0, 1.0])
    assert scene.view("post")["position"] == pytest.approx([0.0, 0.0, 0.1])


@pytest.mark.slow
def test_waiting_for_a_job_that_fails_says_so(tmp_path):
    torn = {**WATER, "solver": "wcsph", "dt": 0.01}
    with pytest.raises(PipelineError, match="has not come to its end"):
        submit(job_of(fluid=[torn], frames=30), output=tmp_path, until=["simulate"]).wait()
