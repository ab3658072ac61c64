"""What is told of a film that does not run on."""

from pathlib import Path

import numpy as np
import pytest
from checked_jobs import checked
from PIL import Image

from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.run.events import TaskEvent, Warned
from pipeline.run.executors.attempt import AttemptContext
from pipeline.run.executors.base import Assignment
from pipeline.stages.movie import MovieStage

JOB = """
name = "pond"
frames = 40
[[rigid]]
name = "ball"
shape = { type = "sphere", radius = 0.1 }
position = [0.0, 0.0, 0.5]
"""
CUT = 30
"""The first frame of the second segment: a break there must be seen, too."""


def picture(x: float) -> Image.Image:
    """A bright disc at x pixels on grey."""
    rows, columns = np.indices((90, 160))
    light = 70 + 150 * np.clip(0.5 - (np.hypot(rows - 45, columns - x) - 20) / 4, 0, 1)
    return Image.fromarray(np.repeat(light.astype(np.uint8)[..., None], 3, axis=2))


def warnings_of(folder: Path, places: list[float]) -> list[str]:
    layout = JobLayout(folder)
    layout.job_file.write_text(JOB)
    (folder / "frames").mkdir()
    for frame, x in enumerate(places):
        picture(x).save(layout.path(layout.picture(frame)))
    events: list[TaskEvent] = []
    for task in MovieStage().plan(load_job(layout.job_file), layout):
        layout.path(task.outputs[0]).parent.mkdir(exist_ok=True)
        assignment = Assignment(task, 1, "f", {}, 1, layout.job_file, layout.root, "pipeline.stages:STAGES")
        MovieStage().run(AttemptContext(assignment, events.append, lambda: False))
    return [event.message for event in events if isinstance(event, Warned)]


EVEN = [30.0 + frame for frame in range(40)]


def test_a_film_that_runs_on_is_made_without_a_word(tmp_path):
    assert warnings_of(tmp_path, EVEN) == []


@pytest.mark.parametrize(
    ("frame", "place", "kind"),
    [(CUT, EVEN[CUT - 1], "repeats"), (12, EVEN[11], "repeats"), (CUT, 130.0, "differs from both")],
)
def test_a_frame_that_repeats_or_pops_up_is_told_with_its_picture(tmp_path, frame, place, kind):
    (told,) = warnings_of(tmp_path, [*EVEN[:frame], place, *EVEN[frame + 1 :]])
    assert told.startswith(f"frame {frame} {kind}")
    assert told.endswith(f"look at it: frames/{frame:06d}.png")


@pytest.mark.parametrize(("of_job", "of_film"), [("fps = {rate}", ""), ("", "playback_fps = {rate}.0")])
def test_a_film_faster_than_its_encoder_takes_is_refused_before_anything_is_drawn(tmp_path, of_job, of_film):
    def errors(rate: int) -> list[str]:
        head, film = of_job.format(rate=rate), of_film.format(rate=rate)
        return checked(f'{head}\n{JOB}[movie]\ncodec = "av1"\n{film}\n', tmp_path / "pond.toml").errors

    assert errors(240) == []
    (error,) = errors(300)
    assert 'movie.codec: "av1" has at most 240 frames a second, got 300' in error
