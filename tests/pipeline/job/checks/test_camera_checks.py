"""What `check` tells of a camera that moves."""

import numpy as np
import pytest
from checked_jobs import checked

from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.stages.render import RenderStage
from pipeline.stages.render_scene import render_spec
from render.spec import Camera

DUCK = """
name = "pond"
duration = 2.0
[[rigid]]
name = "duck"
kind = "kinematic"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.5]
velocity = [0.1, 0.0, 0.0]
[[rigid]]
name = "rock"
shape = { type = "sphere", radius = 0.1 }
position = [0.4, 0.0, 0.5]
"""
FLAG = """
[[cloth]]
name = "flag"
shape = { type = "rectangle", size = [0.2, 0.1], counts = [9, 5] }
position = [0.0, 0.3, 0.5]
"""


@pytest.mark.parametrize(
    ("camera", "complaint"),
    [
        ('follow = "dukc"', 'camera.follow: no dynamic or kinematic rigid body is named "dukc"; did you mean "duck"?'),
        ('follow = "rock"', 'camera.follow: "rock" is static; set camera.look_at to look at it'),
        ('focus = "pike"\nf_stop = 2.8', 'no rigid body is named "pike"; rigid bodies are duck, rock'),
        ('look_at = "flag"', 'camera.look_at: "flag" is no rigid body; its shape changes, so it has no one place'),
    ],
)
def test_a_camera_follows_only_bodies_that_move(tmp_path, camera, complaint):
    with pytest.raises(JobFileError) as refused:
        checked(f"{DUCK}{FLAG}[camera]\n{camera}\n", tmp_path / "pond.toml")
    assert complaint in str(refused.value)


def test_a_camera_that_looks_at_a_body_that_stands_is_the_same_as_one_that_looks_at_its_place(tmp_path):
    def planned(camera: str) -> tuple[Camera, str]:
        assert checked(f"{DUCK}[camera]\nf_stop = 2.8\n{camera}\n", tmp_path / "pond.toml").errors == []
        job = load_job(tmp_path / "pond.toml")
        digest = RenderStage().plan(job, JobLayout(tmp_path))[0].parameters.digest
        return render_spec(job, JobLayout(tmp_path)).camera, digest

    for keys in ("look_at = {}", "look_at = [0.0, 0.0, 0.3]\nfocus = {}"):
        by_name, by_place = (planned(keys.format(rock)) for rock in ('"rock"', "[0.4, 0.0, 0.5]"))
        assert by_name == by_place
        assert by_name[0].views is None, "it does not move"
    view = planned('look_at = [0.0, 0.0, 0.3]\nfocus = "rock"')[0]
    forward = np.subtract(view.look_at, view.position)
    distance = np.subtract((0.4, 0.0, 0.5), view.position) @ forward / np.linalg.norm(forward)
    assert view.focus_distance == pytest.approx(distance)


MOTIONS = [
    "",
    "orbit_deg_per_s = 10.0",
    "orbit_deg_per_s = 45.0",
    'follow = "duck"',
    'look_at = "duck"',
    'follow = "duck"\nlook_at = "duck"',
    "keyframe = [{ time_s = 0, position = [0, -2, 1] }, { time_s = 1, position = [1, -2, 1] }]",
    "keyframe = [{ time_s = 0, position = [0, -2, 1] }, { time_s = 1, position = [2, -2, 1] }]",
    "keyframe = [{ time_s = 0, position = [0, -2, 1] }, { time_s = 1, position = [2, -2, 1] }]\neasing = 'linear'",
]


def test_a_camera_that_moves_otherwise_has_every_frame_drawn_again(tmp_path):
    path = tmp_path / "pond.toml"
    digests = set()
    for motion in MOTIONS:
        path.write_text(f"{DUCK}[camera]\n{motion}\n")
        digests.add(RenderStage().plan(load_job(path), JobLayout(tmp_path))[0].parameters.digest)
    assert len(digests) == len(MOTIONS)


def test_a_turntable_of_still_bodies_moves_and_a_still_camera_on_them_does_not(tmp_path):
    still = DUCK.replace('kind = "kinematic"\n', "").replace("velocity = [0.1, 0.0, 0.0]\n", "")
    path = tmp_path / "pond.toml"
    assert "nothing will move" in checked(still, path).warnings[0]
    assert not checked(still + "[camera]\norbit_deg_per_s = 90.0\n", path).warnings


def test_keyframes_inside_a_body_or_after_the_end_are_told_with_their_place(tmp_path):
    keyframes = """
[[camera.keyframe]]
time_s = 0.0
position = [0.4, 0.02, 0.5]
[[camera.keyframe]]
time_s = 2.5
position = [0.0, -2.0, 0.5]
look_at = [0.0, -2.0, 0.5]
[[camera.keyframe]]
time_s = 2.6
position = [0.0, 0.0, 0.7]
"""
    domain = "[domain]\nmin = [-0.5, -0.5, 0.0]\nmax = [0.5, 0.5, 1.4]\n"
    found = checked(DUCK + domain + keyframes, tmp_path / "pond.toml")
    expected = (
        '20 camera.keyframe[0].position: is inside "rock"',
        "24 camera.keyframe[1].look_at: is where the camera is",
        "25 camera.keyframe[2].look_at: is where the camera is",
        "22 camera.keyframe[1].time_s: is after the film's end at 2 s",
        "26 camera.keyframe[2].time_s: is after the film's end at 2 s",
    )
    assert (len(found.errors), len(found.warnings)) == (3, 2)
    for line, start in zip([*found.errors, *found.warnings], expected, strict=True):
        assert line.startswith(f"pond.toml:{start}")


def warnings_of(camera: str, tmp_path) -> list[str]:
    domain = "[domain]\nmin = [-0.5, -0.5, 0.0]\nmax = [0.5, 0.5, 1.4]\n"
    return checked(f"{DUCK}{domain}[camera]\n{camera}\n", tmp_path / "pond.toml").warnings


@pytest.mark.parametrize(
    ("camera", "complaint"),
    [
        ("position = [0.0, -2.0, -0.3]", "is below the ground, z = 0 m, at 0 s"),
        ("position = [0.0, -2.0, 0.5]\nlook_at = [0.0, -9.0, 0.5]", "looks away from everything at the start"),
        (
            'position = [0.0, -2.0, 0.5]\nlook_at = [0.0, -9.0, 0.5]\nfollow = "duck"',
            "looks away from everything at the start",
        ),
        # It ends above the domain and looks up.
        (
            "keyframe = [{ time_s = 0, position = [0, -3, 0.5] }, "
            "{ time_s = 1, position = [0, 0, 3], look_at = [0, 0, 9] }]",
            "looks away from the domain at 0.992 s and at 1.98 s",
        ),
        # The rock is at x = 0.4, as long as the film lasts.
        (
            "keyframe = [{ time_s = 0, position = [0.4, -2, 0.5] }, { time_s = 2, position = [0.4, 2, 0.5] }]",
            'passes through "rock" at ',
        ),
        # Less than the way to the far point that it looks at, divided by a thousand.
        (
            "position = [0.0, -0.2, 0.5]\nlook_at = [0.0, 200.0, 0.5]",
            'is 0.1 m from "duck", and draws nothing nearer than 0.2 m',
        ),
        ("position = [0.0, -9.0, 0.5]\nlook_at = [0.0, -8.999, 0.5]", "draws nothing farther than 1 m"),
    ],
)
def test_a_camera_that_cannot_see_what_happens_is_told(camera, complaint, tmp_path):
    found = warnings_of(camera, tmp_path)
    assert len(found) == 1 and complaint in found[0], found


def test_a_good_camera_is_not_complained_about(tmp_path):
    goes_along = 'follow = "duck"\nlook_at = "duck"\nfocus = "duck"\nf_stop = 2.8'
    for camera in ("position = [0.0, -2.0, 0.5]", "orbit_deg_per_s = 90.0", 'framing = "action"', goes_along):
        assert not warnings_of(camera, tmp_path)


def test_a_place_where_a_body_that_moves_is_at_the_start_may_be_free_later(tmp_path):
    keyframes = (
        "keyframe = [{ time_s = 0, position = [0, -3, 0.5] }, "
        "{ time_s = 1, position = [0, 0, 0.5], look_at = [0.4, 0, 0.5] }]"
    )
    found = checked(f"{DUCK}[camera]\n{keyframes}\n", tmp_path / "pond.toml")
    assert found.errors == []
    assert any('is where "duck" is at the start' in warning for warning in found.warnings)
