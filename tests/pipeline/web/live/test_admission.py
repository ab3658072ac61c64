"""Which jobs run live, and what the others are told."""

import pytest
from command_line import pipeline
from live_jobs import BALL_OVER_SHEET, live, loaded
from places import PROJECT

from pipeline.base.errors import PipelineError
from pipeline.job.loading import load_job
from pipeline.job.starter import write_starter
from pipeline.kinds.work import cloth_frame_s, fewest_for_bodies, fluid_frame_s, steps_a_frame
from pipeline.web.live.admission import (
    FEWEST_SUBSTEPS,
    FLUENT_FRAME_S,
    fluent,
    fluent_frame_s,
    live_job,
    require_small,
    told_changes,
)
from pipeline.web.live.parameters import parameters_of
from pipeline.web.live.saving import save_job

JOBS = PROJECT / "jobs"


def test_a_scene_that_is_too_large_is_told_what_fits(tmp_path):
    large = live_job(loaded(tmp_path, BALL_OVER_SHEET.replace("[17, 17]", "[401, 401]")).job, substeps=20)
    with pytest.raises(PipelineError, match=r"160,801 cloth nodes at 20 substeps .* about [\d,]+ nodes fit.*--anyway"):
        require_small(large, 0, cores=2, on_gpu=False)
    require_small(live_job(loaded(tmp_path).job), 0, cores=1, on_gpu=False)


def told_of(monkeypatch, *arguments: str) -> str:
    """What the command says of a job on two cores, without running it."""
    monkeypatch.setattr("pipeline.web.live.running.show_live", lambda *_, **__: None)
    monkeypatch.setattr("pipeline.kinds.checks.memory_budget.resolve_device", lambda _: "cpu")
    return pipeline("live", *arguments, "--cores", 2).output


def test_the_drop_to_start_from_is_let_in(tmp_path, monkeypatch):
    job_file = write_starter(tmp_path / "my-film", "drop")
    assert "too large" not in told_of(monkeypatch, str(job_file))


def test_honey_is_told_by_what_flows_in_during_the_film_and_what_its_viscosity_takes(monkeypatch):
    told = told_of(monkeypatch, str(JOBS / "honey.toml"))
    assert "honey is too large to steer: about 13,408 particles at 7 steps a frame" in told
    honey = live_job(load_job(JOBS / "honey.toml"))
    thin = honey.model_copy(update={"fluid": (honey.fluid[0].model_copy(update={"viscosity": 1e-6}),)})
    step_s = [fluid_frame_s(job, 3360, power=1) / steps_a_frame(job) for job in (honey, thin)]
    assert step_s[0] > 4.0 * step_s[1]
    assert "too large" not in told_of(monkeypatch, str(JOBS / "honey.toml"), "--preview")


def test_finer_particles_take_more_steps_and_fixed_ones_what_they_say():
    job = live_job(load_job(JOBS / "dam_break.toml"))

    def steps(**changes: object) -> float:
        return steps_a_frame(job.model_copy(update={"fluid": (job.fluid[0].model_copy(update=changes),)}))

    radius = job.fluid[0].particle_radius
    assert steps(particle_radius=radius / 2.0) == pytest.approx(2.0 * steps())
    assert steps(dt=1.0e-3) == pytest.approx(1.0e3 / job.fps)
    assert steps(solver="wcsph") > 4.0 * steps()
    assert steps(viscosity=0.1, viscosity_solver="explicit") > 4.0 * steps()


@pytest.mark.parametrize(("fps", "most"), [(24, "0.25 s at most"), (60, "0.25 s at most"), (240, "0.062 s at most")])
def test_a_scene_may_be_as_many_times_slower_than_real_time_at_any_rate_of_frames(monkeypatch, fps: int, most: str):
    assert most in told_of(monkeypatch, str(JOBS / "dam_break.toml"), "--set", f"fps={fps}")


@pytest.mark.parametrize(
    ("counts", "substeps", "remedy"),
    [
        ("[175, 175]", 20, " fit, or --substeps 11 (--preview"),
        ("[230, 230]", 20, " fit (--preview"),
        ("[230, 230]", 6, " fit (--preview"),
    ],
)
def test_no_substeps_are_offered_that_bodies_do_not_let_cloth_take(tmp_path, counts: str, substeps: int, remedy: str):
    job = live_job(loaded(tmp_path, BALL_OVER_SHEET.replace("[17, 17]", counts)).job, substeps=substeps)
    with pytest.raises(PipelineError) as refused:
        require_small(job, 0, cores=2, on_gpu=False)
    assert f"at {max(substeps, fewest_for_bodies(job))} substeps a frame" in str(refused.value)
    assert remedy in str(refused.value)


def test_explicit_springs_are_offered_no_substeps(tmp_path):
    text = BALL_OVER_SHEET.replace("[17, 17]", "[175, 175]").replace("substeps = 8\n", 'integrator = "explicit"\n')
    with pytest.raises(PipelineError, match=r"nodes fit \(--preview"):
        require_small(live_job(loaded(tmp_path, text).job), 0, cores=2, on_gpu=False)


@pytest.mark.parametrize(
    ("counts", "substeps", "collides"),
    [("[17, 17]", 20, True), ("[65, 65]", 11, True), ("[80, 80]", 18, False), ("[100, 100]", 11, False)],
)
def test_cloth_that_is_too_slow_gives_up_substeps_then_its_collisions_and_that_is_told(
    tmp_path, counts: str, substeps: int, collides: bool
):
    text = BALL_OVER_SHEET.replace("[17, 17]", counts).replace("substeps = 8\n", "")
    written = loaded(tmp_path, text).job
    job = fluent(live_job(written), power=2)
    (cloth,) = job.cloth
    assert (cloth.substeps or 20, cloth.self_collision) == (substeps, collides)
    assert cloth_frame_s(job, power=2) <= FLUENT_FRAME_S
    told = told_changes(written, {knob.name: knob.start for knob in parameters_of(job)})
    assert (f"{substeps} substeps a frame instead of 20" in told) == (substeps != 20)
    assert ('"sheet" does not collide with itself' in told) == (not collides)
    written_values = {knob.name: knob.start for knob in parameters_of(written)}
    assert told_changes(written, written_values) == ""


@pytest.mark.parametrize("fps", [24, 60, 120, 240])
def test_cloth_is_fluent_if_it_is_half_as_fast_as_in_real_time(tmp_path, fps: int):
    text = BALL_OVER_SHEET.replace("[17, 17]", "[65, 65]").replace("substeps = 8\n", "")
    text = text.replace('kind = "dynamic"\ndensity = 500.0\n', "")
    job = fluent(live_job(loaded(tmp_path, f"fps = {fps}\n{text}").job), power=2)
    assert cloth_frame_s(job, power=2) <= fluent_frame_s(job) == pytest.approx(min(1.0 / 30.0, 2.0 / fps))
    assert job.cloth[0].self_collision == (fps <= 60)


def test_a_job_that_is_saved_has_the_pace_that_it_was_played_with(tmp_path):
    read = loaded(tmp_path, BALL_OVER_SHEET.replace("[17, 17]", "[100, 100]").replace("substeps = 8\n", ""))
    values = {knob.name: knob.start for knob in parameters_of(fluent(live_job(read.job), power=2))}
    (cloth,) = load_job(save_job(read, values, tmp_path)[0]).cloth
    assert (cloth.substeps, cloth.self_collision) == (11, False)


@pytest.mark.parametrize(("kind", "substeps"), [("dynamic", 9), ("static", FEWEST_SUBSTEPS)])
def test_no_fewer_substeps_are_told_than_bodies_take(tmp_path, kind: str, substeps: int):
    text = BALL_OVER_SHEET.replace("[17, 17]", "[150, 150]").replace("substeps = 8\n", "")
    if kind == "static":
        text = text.replace('kind = "dynamic"\ndensity = 500.0\n', "")
    written = loaded(tmp_path, text).job
    job = fluent(live_job(written), power=2)
    assert fewest_for_bodies(job) == (9 if kind == "dynamic" else 1)
    assert (job.cloth[0].substeps, job.cloth[0].self_collision) == (substeps, False)
    taken = live_job(written, substeps=9 if kind == "dynamic" else 2)
    assert cloth_frame_s(live_job(written, substeps=2), power=2) == cloth_frame_s(taken, power=2)


def test_explicit_springs_keep_the_steps_that_they_need(tmp_path):
    text = BALL_OVER_SHEET.replace("[17, 17]", "[100, 100]").replace("substeps = 8\n", 'integrator = "explicit"\n')
    job = live_job(loaded(tmp_path, text).job)
    assert fluent(job, power=2) is job


def test_bodies_at_rest_can_be_led_but_not_in_a_fluid(tmp_path):
    job = live_job(loaded(tmp_path).job)
    assert [body.kind for body in job.rigid] == ["dynamic", "kinematic"]
    fluid = """
[[fluid]]
name = "water"
particle_radius = 0.04
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }
position = [0.0, 0.3, 0.2]
"""
    job = live_job(loaded(tmp_path, BALL_OVER_SHEET + fluid).job)
    assert [body.kind for body in job.rigid] == ["dynamic", "static"]


def test_smoke_and_jobs_where_nothing_moves_are_refused(tmp_path):
    still = 'name = "still"\n[[rigid]]\nname = "box"\nshape = { type = "box", size = [0.1, 0.1, 0.1] }\n'
    with pytest.raises(PipelineError, match="nothing moves in it"):
        live_job(loaded(tmp_path, still).job)
    smoke = """
[[smoke]]
name = "plume"
cell_size = 0.1
[[smoke.source]]
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.2]
"""
    with pytest.raises(PipelineError, match="smoke does not run live"):
        live_job(loaded(tmp_path, BALL_OVER_SHEET + smoke).job)


def test_substeps_of_ones_own_and_those_of_the_job_are_not_had_at_once(tmp_path):
    outcome = live(tmp_path, "--as-written", "--substeps", 6)
    assert outcome.exit_code == 2
    assert "give one of them" in outcome.output


def test_several_sheets_keep_their_collisions_as_they_meet_each_other_anyway(tmp_path):
    text = BALL_OVER_SHEET.replace("[17, 17]", "[100, 100]").replace("substeps = 8\n", "")
    job = live_job(loaded(tmp_path, text).job)
    two = job.model_copy(update={"cloth": (*job.cloth, job.cloth[0].model_copy(update={"name": "other"}))})
    assert all(cloth.self_collision for cloth in fluent(two, power=2).cloth)
