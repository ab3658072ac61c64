"""The preview movie while a job runs: which frames it shows, when it goes, and what it cannot harm."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import drawing_stages
import psutil
import pytest
from click.testing import Result
from command_line import pipeline
from farm_processes import wait_until
from places import HELPERS, PROJECT
from processes_seen import lives

from pipeline.base.layout import JobLayout
from pipeline.base.task import TaskState
from pipeline.job.loading import load_job
from pipeline.queue.preview_movie import PreviewMovie
from pipeline.run.events import Committed, RunStarted, StateChanged
from pipeline.run.plan import NEVER_MADE, Assessment, Reason, Verdict, plan_job, spread_turns
from pipeline.stages import STAGES
from pipeline.store.receipts import Receipt
from render.movie import validate_movie

FRAMES = 8


@pytest.fixture(autouse=True)
def without_pauses(monkeypatch) -> None:
    """Films as often as they can be made, and tasks that draw."""
    monkeypatch.setattr("pipeline.queue.preview_movie.SHORTEST_PAUSE_S", 0.01)
    monkeypatch.setattr("pipeline.queue.preview_movie.SHARE", 1.0e6)
    # What is imported for it keeps the real stages.
    monkeypatch.setattr("pipeline.queue.turns.STAGES_REFERENCE", drawing_stages.REFERENCE)
    monkeypatch.setattr("pipeline.stages.STAGES", drawing_stages.STAGES)


def write_job(folder: Path, *, frames: int = FRAMES, gravity: float = -9.0, more: str = "") -> Path:
    """A job called `job`; returns its file."""
    path = folder / "job.toml"
    path.write_text(
        f'name = "job"\nframes = {frames}\nfps = 24\ngravity = [0.0, 0.0, {gravity}]\n{more}\n'
        '[[rigid]]\nname = "ball"\nshape = { type = "sphere", radius = 0.1 }\nposition = [0.5, 0.5, 0.3]\n'
    )
    return path


def submit(folder: Path, *arguments: str, **told: float) -> tuple[Result, JobLayout]:
    """Submit the job to `renders/`, drawn in this process, with orders for its frames."""
    layout = JobLayout(folder / "renders" / "job")
    layout.root.mkdir(parents=True, exist_ok=True)
    (layout.root / "drawing.json").write_text(json.dumps(told))
    result = pipeline("submit", folder / "job.toml", "--farm", folder / "renders", "--executor", "inline", *arguments)
    return result, layout


def colors(path: Path) -> list[tuple[int, int]]:
    """Of each frame which picture it shows, and gravity."""
    with av.open(str(path)) as container:
        assert float(container.streams.video[0].average_rate) == 24.0
        means = [
            frame.reformat(format="rgb24", src_colorspace=1, dst_colorspace=1).to_ndarray()[:48].mean(axis=(0, 1))
            for frame in container.decode(video=0)
        ]
    return [(round(red / 8), -round(green / 10)) for red, green, _ in means]


def test_while_frames_are_drawn_there_is_a_film_of_them_and_at_the_end_it_is_gone(tmp_path):
    write_job(tmp_path)
    result, layout = submit(tmp_path, wait=5)
    assert result.exit_code == 0, result.output
    shown = [frame for frame, _ in colors(layout.root / "seen.mp4")]
    last = max(shown)
    assert shown == [min(frame, last) for frame in range(FRAMES)]
    assert f"the preview movie, made anew now and then: {layout.preview_movie}" in result.stderr
    assert not layout.preview_movie.exists()
    assert not layout.preview_scratch.exists()
    validate_movie(layout.film, FRAMES)


def test_frames_from_all_over_the_film_come_first_where_the_job_wants_them(tmp_path):
    write_job(tmp_path, more='render.order = "spread"')
    result, layout = submit(tmp_path, wait=6)  # the last one that is drawn
    assert result.exit_code == 0, result.output
    turns = spread_turns(FRAMES)
    order = sorted(range(FRAMES), key=lambda frame: turns[frame])
    assert order[-1] == 6
    drawn = {frame for frame, _ in colors(layout.root / "seen.mp4")}
    assert drawn == set(order[: len(drawn)])


def test_a_failed_run_leaves_the_film_so_far_and_status_names_it(tmp_path):
    write_job(tmp_path)
    result, layout = submit(tmp_path, wait=6, fail=7)
    assert result.exit_code == 5, result.output
    validate_movie(layout.preview_movie, FRAMES)
    assert not layout.preview_scratch.exists()
    assert f"preview movie: {layout.preview_movie}" in pipeline("status", layout.root).stdout
    assert json.loads(pipeline("status", layout.root, "--json").stdout)["preview_movie"] == str(layout.preview_movie)
    result, _ = submit(tmp_path)
    assert result.exit_code == 0, result.output
    assert not layout.preview_movie.exists()
    assert "preview movie" not in pipeline("status", layout.root).stdout
    assert json.loads(pipeline("status", layout.root, "--json").stdout)["preview_movie"] is None


def test_frames_of_an_earlier_version_of_the_job_are_not_shown(tmp_path):
    write_job(tmp_path)
    assert submit(tmp_path)[0].exit_code == 0
    write_job(tmp_path, gravity=-20.0)
    result, layout = submit(tmp_path, wait=4)
    assert result.exit_code == 0, result.output
    assert {gravity for _, gravity in colors(layout.root / "seen.mp4")} == {-20}


def test_a_job_can_do_without_and_the_film_so_far_of_an_earlier_run_goes(tmp_path):
    write_job(tmp_path)
    result, layout = submit(tmp_path, wait=6, fail=7)
    assert result.exit_code == 5, result.output
    assert layout.preview_movie.exists()
    write_job(tmp_path, more="movie.so_far = false")
    layout.path(layout.picture(0)).unlink()
    result, _ = submit(tmp_path, pause_s=0.4)
    assert result.exit_code == 0, result.output
    assert "the preview movie" not in result.output
    assert not layout.preview_movie.exists()


@pytest.mark.parametrize("changed", [True, False])
def test_a_film_so_far_is_not_shown_as_that_of_a_later_version_of_the_job(tmp_path, changed):
    write_job(tmp_path)
    assert submit(tmp_path, wait=6, fail=7)[0].exit_code == 5
    write_job(tmp_path, gravity=-20.0 if changed else -9.0)
    result, layout = submit(tmp_path, fail=0 if changed else 7)
    assert result.exit_code == 5, result.output
    if changed:
        assert not layout.preview_movie.exists()
    else:
        assert {gravity for _, gravity in colors(layout.preview_movie)} == {-9}


def test_the_key_runs_nothing_again(tmp_path):
    layout = JobLayout(tmp_path)
    write_job(tmp_path)
    tasks = plan_job(load_job(layout.job_file), layout, STAGES)
    write_job(tmp_path, more="movie.so_far = false")
    assert plan_job(load_job(layout.job_file), layout, STAGES) == tasks


def test_a_film_that_cannot_be_made_is_one_warning_and_the_job_goes_on(tmp_path):
    write_job(tmp_path, frames=40)
    layout = JobLayout(tmp_path / "renders" / "job")
    layout.preview_movie.mkdir(parents=True)
    (layout.preview_movie / "something").write_text("in its way")

    result, _ = submit(tmp_path, pause_s=0.1)
    assert result.exit_code == 0, result.output
    assert result.stderr.count("no preview movie could be made") == 1
    validate_movie(layout.film, 40)


# --- the observer alone ---


def watched(folder: Path, *, frames: int, drawn: int) -> tuple[PreviewMovie, list[str], list[Assessment]]:
    """An observer of a job whose first frames are there and up to date, what it says, and the job's tasks."""
    layout = JobLayout(folder)
    job = load_job(write_job(folder, frames=frames))
    tasks = plan_job(job, layout, drawing_stages.STAGES)
    (folder / "frames").mkdir()
    for frame in range(drawn):
        color = (8 * frame % 256, 90, 20)
        drawing_stages.Image.new("RGB", drawing_stages.SIZE, color).save(layout.path(layout.picture(frame)))
    said: list[str] = []
    assessments = [
        Assessment(task, Verdict.UP_TO_DATE)
        if task.frame is not None and task.stage == "render" and task.frame < drawn
        else Assessment(task, Verdict.DOWNSTREAM, rebuilds=task.outputs)
        for task in tasks
    ]
    return PreviewMovie(job, layout, said.append, said.append), said, assessments


def test_a_frame_that_turns_out_up_to_date_is_shown(tmp_path):
    observer, _, assessments = watched(tmp_path, frames=4, drawn=3)
    for each in range(1, 3):
        task = assessments[each].task
        assessments[each] = Assessment(task, Verdict.DOWNSTREAM, rebuilds=task.outputs)
    with observer:
        observer.notify(RunStarted(assessments))
        wait_until(JobLayout(tmp_path).preview_movie.exists, "no film")
        assert [frame for frame, _ in colors(JobLayout(tmp_path).preview_movie)] == [0, 0, 0, 0]
        observer.notify(StateChanged(assessments[2].task.id, "render", TaskState.UP_TO_DATE))
        wait_until(
            lambda: [frame for frame, _ in colors(JobLayout(tmp_path).preview_movie)] == [0, 0, 2, 2],
            "it does not grow",
        )


def test_a_film_that_may_hold_frames_of_an_earlier_version_goes_when_a_run_begins(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.queue.preview_movie.SHORTEST_PAUSE_S", 600.0)
    _, _, assessments = watched(tmp_path, frames=4, drawn=2)
    film = JobLayout(tmp_path).preview_movie
    never = (Reason("never made", NEVER_MADE),)
    changed = (Reason("gravity changed", "gravity changed"),)

    def left_by(*reasons: tuple[Reason, ...]) -> bool:
        film.write_bytes(b"an earlier one")
        with PreviewMovie(load_job(JobLayout(tmp_path).job_file), JobLayout(tmp_path), print, print) as observer:
            stale = [
                Assessment(each.task, Verdict.STALE, why) for each, why in zip(assessments[2:4], reasons, strict=True)
            ]
            observer.notify(RunStarted([*assessments[:2], *stale, *assessments[4:]]))
        return film.exists()

    assert left_by(never, never)
    assert not left_by(never, changed)


def test_a_film_takes_a_small_share_of_the_time(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.queue.preview_movie.SHARE", 1.0e-4)
    observer, said, assessments = watched(tmp_path, frames=400, drawn=200)
    layout = JobLayout(tmp_path)
    with observer:
        stale = [Assessment(each.task, Verdict.STALE) for each in assessments[100:]]
        observer.notify(RunStarted([*assessments[:100], *stale]))
        wait_until(layout.preview_movie.exists, "no film")
        first = layout.preview_movie.stat().st_mtime_ns
        for each in stale[:60]:
            time.sleep(0.05)
            receipt = Receipt(each.task.outputs[0], each.task.id, each.task.stage, 1, "f", "p", 1, 1, "h")
            observer.notify(Committed(each.task.id, 1, receipt))
    # It takes a quarter of a second at least for its imports alone: the next one is due after 40 minutes.
    assert layout.preview_movie.stat().st_mtime_ns == first, said


def test_a_killed_runner_leaves_neither_a_child_nor_half_a_film(tmp_path):
    observer, _, assessments = watched(tmp_path, frames=20_000, drawn=2)
    layout = JobLayout(tmp_path)
    program = tmp_path / "runner.py"
    program.write_text(
        "import sys, time\n"
        f"sys.path[:0] = [{str(HELPERS)!r}, {str(PROJECT)!r}]\n"
        "from pathlib import Path\n"
        "import drawing_stages, pipeline.queue.preview_movie\n"
        "from pipeline.job.loading import load_job\n"
        "from pipeline.base.layout import JobLayout\n"
        "from pipeline.run.plan import Assessment, Verdict, plan_job\n"
        "from pipeline.run.events import RunStarted\n"
        "pipeline.queue.preview_movie.SHORTEST_PAUSE_S = 0.01\n"
        f"layout = JobLayout(Path({str(tmp_path)!r}))\n"
        "job = load_job(layout.job_file)\n"
        "tasks = plan_job(job, layout, drawing_stages.STAGES)\n"
        "with pipeline.queue.preview_movie.PreviewMovie(job, layout, print, print) as observer:\n"
        "    up, todo = Verdict.UP_TO_DATE, Verdict.STALE\n"
        "    observer.notify(RunStarted([Assessment(task, up if n < 2 else todo) for n, task in enumerate(tasks)]))\n"
        "    time.sleep(600)\n"
    )
    part = layout.preview_scratch / "film.mp4"
    with subprocess.Popen([sys.executable, program], stdout=subprocess.DEVNULL) as runner:
        wait_until(part.exists, "it does not begin")
        children = psutil.Process(runner.pid).children(recursive=True)
        os.kill(runner.pid, signal.SIGKILL)
    assert len(children) == 1
    wait_until(lambda: not any(map(lives, children)), "the child goes on")
    assert not layout.preview_movie.exists()
    with observer:  # as the next run
        done = [Assessment(each.task, Verdict.UP_TO_DATE) for each in assessments]
        observer.notify(RunStarted(done))
    assert not layout.preview_scratch.exists()


def test_the_end_of_a_run_does_not_wait_for_a_film(tmp_path):
    observer, said, assessments = watched(tmp_path, frames=20_000, drawn=2)
    layout = JobLayout(tmp_path)
    with observer:
        observer.notify(RunStarted(assessments))
        wait_until((layout.preview_scratch / "film.mp4").exists, "it does not begin")
        began = time.monotonic()
    assert time.monotonic() - began < 10.0  # the whole film takes a minute
    assert said == []
    assert not layout.preview_movie.exists()
    assert not layout.preview_scratch.exists()
