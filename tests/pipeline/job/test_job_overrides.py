"""`--set` and `--preview`: what they change, what they keep, and what they refuse."""

from pathlib import Path

import pytest
from checked_jobs import says

from pipeline.base.errors import JobFileError
from pipeline.job.loading import LoadedJob, load_job, read_job
from pipeline.job.starter import TEMPLATES, starter

TEXT = """\
# my film
name = "dam"  # its name

[domain]
max = [1.0, 1.0, 1.0]

[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }

[[rigid]]
name = "pillar"
shape = { type = "box", size = [0.1, 0.1, 0.5] }

[[fluid]]
name = "water"
dt = 0.001  # fixed
[[fluid.block]]
shape = { type = "box", size = [0.2, 0.2, 0.2] }

[material.ball]
look = "metal"
"""


def loaded(tmp_path: Path, *overrides: str, text: str = TEXT, preview: bool = False) -> LoadedJob:
    path = tmp_path / "dam.toml"
    path.write_text(text)
    return read_job(path, overrides, preview=preview)


@pytest.mark.parametrize(
    ("override", "read", "expected"),
    [
        ("render.quality=final", lambda job: job.render.quality, "final"),
        ('render.quality = "final"', lambda job: job.render.quality, "final"),
        ("fps=30", lambda job: job.fps, 30),
        ("fluid.water.viscosity=1e-3", lambda job: job.fluid[0].viscosity, 1e-3),
        ("fluid.0.dt=adaptive", lambda job: job.fluid[0].dt, "adaptive"),
        ("rigid.pillar.shape.size=[1, 2, 3]", lambda job: job.rigid[1].shape.size, (1.0, 2.0, 3.0)),
        ("rigid.1.shape.size.2=0.25", lambda job: job.rigid[1].shape.size, (0.1, 0.1, 0.25)),
        ("rigid.ball.shape={type='duck', length=1}", lambda job: job.rigid[0].shape.type, "duck"),
        ("fluid.water.block.0.velocity=[0,0,-1]", lambda job: job.fluid[0].block[0].velocity, (0.0, 0.0, -1.0)),
        ("material.pillar.look=stone", lambda job: job.material["pillar"].look, "stone"),
        ("material.ball.roughness=0.5", lambda job: job.material["ball"].roughness, 0.5),
        ("camera.position=[1,2,3]", lambda job: job.camera.position, (1.0, 2.0, 3.0)),
        ("render.blender=/opt/blender=5/blender", lambda job: job.render.blender, "/opt/blender=5/blender"),
    ],
)
def test_override_changes_this_key_and_no_other(override, read, expected, tmp_path):
    changed = loaded(tmp_path, override)
    assert read(changed.job) == expected
    original = loaded(tmp_path).job.model_dump()
    differing = [key for key, value in changed.job.model_dump().items() if value != original[key]]
    assert len(differing) == 1


def test_saved_text_holds_the_overrides_keeps_comments_and_gives_the_same_job(tmp_path):
    changed = loaded(tmp_path, "fluid.water.dt=adaptive", "render.quality=draft", "fps=24", preview=True)
    for comment in ("# my film", "# its name", "# fixed"):
        assert comment in changed.text
    assert loaded(tmp_path, text=changed.text).job == changed.job


LED = """
[camera]
f_stop = 2.8
easing = "linear"
[[camera.keyframe]]
time_s = 0.0
position = [0.0, -2.0, 1.0]
[[camera.keyframe]]
time_s = 1.0
position = [2.0, -2.0, 1.0]
[[light]]
position = [1.0, 1.0, 1.0]
[set]
name = "night"
"""


def test_a_list_of_tables_is_replaced_by_another_or_by_none(tmp_path):
    changes = ("camera.keyframe=[{time_s = 0.5, position = [0, -3, 1]}]", "light=[]", "camera.f_stop=4.0")
    changed = loaded(tmp_path, *changes, text=TEXT + LED)
    assert [key.time_s for key in changed.job.camera.keyframe] == [0.5]
    assert (changed.job.light, changed.job.camera.f_stop, changed.job.set.name) == ((), 4.0, "night")
    assert loaded(tmp_path, text=changed.text).job == changed.job
    assert len(loaded(tmp_path, "light=[{position = [0, 0, 1]}, {position = [1, 0, 1]}]").job.light) == 2


def test_later_override_wins(tmp_path):
    assert loaded(tmp_path, "fps=24", "fps=25").job.fps == 25


def test_an_element_that_a_new_list_does_not_have_is_told(tmp_path):
    with pytest.raises(JobFileError) as error:
        loaded(tmp_path, "camera.keyframe=[]", "camera.keyframe.1.time_s=2", text=TEXT + LED)
    assert error.value.problems == ["--set: camera.keyframe[1].time_s is not there once the list is set"]


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("fps", "--set fps: expected path.to.key=value"),
        ("=3", "--set =3: expected path.to.key=value"),
        ("render.qualty=final", '--set render.qualty: no key "qualty" in render; did you mean "quality"?'),
        ("rendr.quality=final", '--set rendr.quality: no key "rendr" in a job; did you mean "render"?'),
        ("fps.x=3", '--set fps.x: no key "x" in fps'),
        ("fluid.wter.dt=1", '--set fluid.wter.dt: no element "wter" in fluid; did you mean "water"?'),
        ("rigid.2.scale=1", '--set rigid.2.scale: no element "2" in rigid; it has 0 (ball), 1 (pillar)'),
        ("rigid.-1.scale=1", '--set rigid.-1.scale: no element "-1" in rigid; it has 0 (ball), 1 (pillar)'),
        ("smoke.0.cfl=1", "--set smoke.0.cfl: the job has no smoke to change"),
        ("domain=3", "--set domain=3: domain is a table; set its keys: min, max, open_faces"),
        ("rigid.ball=3", "--set rigid.ball=3: rigid[0] is a table; set its keys: shape, position ... keyframe"),
        ("camera.keyframe=3", "--set camera.keyframe=3: camera.keyframe is a list of tables ... time_s, position"),
        ("rigid.ball.shape.radius=-1", "--set rigid[0].shape.radius: must be > 0 m, got -1"),
        ("fps=fast", '--set fps: expected a whole number, got the text "fast"'),
    ],
)
def test_a_wrong_override_is_told_in_one_line(override, expected, tmp_path):
    with pytest.raises(JobFileError) as error:
        loaded(tmp_path, override)
    (problem,) = error.value.problems
    assert says(problem, expected)


def test_all_wrong_overrides_are_told_at_once(tmp_path):
    with pytest.raises(JobFileError) as error:
        loaded(tmp_path, "fbs=3", "render.samples=8", "cmera.f_stop=8")
    assert len(error.value.problems) == 2


@pytest.mark.parametrize("template", TEMPLATES)
def test_preview_is_the_same_scene_coarser_smaller_and_under_another_name(template, tmp_path):
    text = starter("film", template, file="film.toml")
    full, preview = loaded(tmp_path, text=text).job, loaded(tmp_path, text=text, preview=True).job
    assert preview.name == "film-preview"
    assert preview.render.quality == "draft"
    assert preview.render.resolution == (480, 270)
    assert preview.frame_count == full.frame_count
    assert (preview.domain, preview.camera, preview.rigid) == (full.domain, full.camera, full.rigid)
    assert [fluid.particle_radius for fluid in preview.fluid] == [2 * fluid.particle_radius for fluid in full.fluid]
    assert [smoke.cell_size for smoke in preview.smoke] == [2 * smoke.cell_size for smoke in full.smoke]


@pytest.mark.parametrize(("full", "half"), [((1280, 720), (640, 360)), ((854, 480), (428, 240)), ((16, 18), (16, 16))])
def test_preview_resolution_is_even_and_never_below_the_least(full, half, tmp_path):
    text = f"{TEXT}\n[render]\nresolution = {list(full)}\nsamples = 2\n"
    preview = loaded(tmp_path, text=text, preview=True).job
    assert preview.render.resolution == half
    assert preview.render.samples == 1
    assert preview.fluid[0].dt == 0.002


def test_problem_that_the_preview_causes_names_the_option(tmp_path):
    with pytest.raises(JobFileError) as error:
        loaded(tmp_path, text=TEXT.replace('"water"', '"water"\nparticle_radius = 1e308'), preview=True)
    assert error.value.problems == ["--preview fluid[0].particle_radius: must be finite, got inf"]


def test_frames_take_the_place_of_a_duration_and_the_other_way_round(tmp_path):
    path = tmp_path / "dam.toml"
    path.write_text('name = "dam"\nduration = 2.0\n')
    assert load_job(path, ["frames=40"]).frame_count == 40
    path.write_text('name = "dam"\nframes = 40\n')
    assert load_job(path, ["duration=2"]).frame_count == 120
    with pytest.raises(JobFileError, match="not both"):
        load_job(path, ["duration=2", "frames=3"])
