"""What the user sees of a run."""

import io
import itertools
import re

import pytest
from record_samples import film
from rich.console import Console

from pipeline.base import wording
from pipeline.base.task import FailureKind, Task, TaskId, TaskState
from pipeline.run.events import Committed, Failed, Notice, Progress, RunStarted, StateChanged
from pipeline.run.plan import Assessment, Reason, Verdict
from pipeline.run.progress import LiveDisplay, PlainDisplay, ProgressObserver, StageProgress, remaining_of_all_s
from pipeline.store.receipts import Receipt

FRAMES = 3


def all_stale() -> list[Assessment]:
    return [Assessment(task, Verdict.STALE, rebuilds=task.outputs) for task in film(FRAMES)]


def committed(task: Task, index: int = 0, *, attempt: int = 1) -> Committed:
    receipt = Receipt(task.outputs[index], task.id, task.stage, attempt, "f", "p", 1, 1, "h")
    return Committed(task.id, attempt, receipt)


def observe(*events: object) -> tuple[ProgressObserver, str]:
    """Everything that a run without a terminal prints."""
    stream = io.StringIO()
    with ProgressObserver(PlainDisplay(stream)) as observer:
        for event in events:
            observer.notify(event)
    return observer, stream.getvalue()


def lines(printed: str) -> list[str]:
    """Without the times at their beginning."""
    return [re.sub(r"^\[ *[0-9.]+ s\] ", "", line) for line in printed.splitlines()]


def test_a_stage_is_counted_by_its_artifacts_and_its_end_is_said():
    simulate, first, second, *_ = film(FRAMES)
    observer, printed = observe(
        RunStarted(all_stale()),
        committed(simulate, 0),
        Progress(simulate.id, 1, 1, FRAMES, "frame 0"),
        committed(first),
        committed(simulate, 1),
        committed(simulate, 2),
        committed(second),
    )
    assert [(stage.name, stage.done, stage.total) for stage in observer.stages.values()] == [
        ("simulate", FRAMES, FRAMES),
        ("render", 2, FRAMES),
        ("movie", 0, 1),
    ]
    assert [line.partition(",")[0] for line in lines(printed)] == [f"simulate {FRAMES}/{FRAMES}"]


def test_what_two_attempts_commit_and_what_a_task_found_there_count_once():
    _, first, second, *_ = film(FRAMES)
    observer, _ = observe(
        RunStarted(all_stale()),
        committed(first),
        committed(first, attempt=2),
        StateChanged(first.id, "render", TaskState.SUCCEEDED),
        StateChanged(second.id, "render", TaskState.UP_TO_DATE),
    )
    assert observer.stages["render"].done == 2


def test_the_reasons_are_said_before_a_change_is_run_but_not_for_a_new_job():
    simulate, *rest = film(FRAMES)
    reason = Reason("camera.position changed", "camera.position changed")
    changed = [
        Assessment(simulate, Verdict.UP_TO_DATE),
        *(Assessment(task, Verdict.STALE, (reason,), task.outputs) for task in rest[:FRAMES]),
        Assessment(rest[-1], Verdict.DOWNSTREAM, (), rest[-1].outputs),
    ]
    assert lines(observe(RunStarted(changed))[1]) == [
        "render 0-2: stale, camera.position changed",
        "film: runs if its inputs turn out different",
    ]
    assert observe(RunStarted(all_stale()))[1] == ""


def test_failures_and_notices_are_sentences():
    printed = observe(
        RunStarted(all_stale()),
        Notice("stopping at once"),
        Failed(TaskId("render/000001"), 2, FailureKind.TIMED_OUT, "took more than 60 s"),
        StateChanged(TaskId("render/000001"), "render", TaskState.FAILED),
    )
    assert lines(printed[1]) == ["stopping at once", "render/000001 (attempt 2) timed out: took more than 60 s"]
    assert printed[0].stages["render"].describe(0.0) == "0/3, 1 failed"


def test_rate_and_remaining_time_leave_out_the_start_and_what_was_there_already():
    stage = StageProgress("render", total=100, done=40, at_start=40)
    for now in (10.0, 12.0, 14.0, 16.0):  # the first took long to start: Blender had to be loaded
        stage.advance(1, now)
    assert stage.rate(16.0) == pytest.approx(0.5)
    assert stage.remaining_s(16.0) == pytest.approx(56 / 0.5)
    assert stage.describe(16.0) == "44/100, 0.50/s, 1 min 52 s left"


def test_what_is_done_once_on_a_machine_says_nothing_about_the_rate():
    """Kernels compile for 70 s before the second frame."""
    stage = StageProgress("simulate", total=100, done=0)
    stage.advance(1, 0.0)
    stage.prepare(1.0)
    stage.prepare(30.0)
    assert stage.rate(30.0) is None
    stage.end_preparing(71.0)
    for now in (72.0, 74.0, 76.0):
        stage.advance(1, now)
    assert stage.rate(76.0) == pytest.approx(3 / (76.0 - 70.0))


def test_compiling_is_said_once_and_ends_with_the_frame():
    simulate = film(FRAMES)[0]
    compiling = Progress(simulate.id, 1, 0, 1, "compiling kernels, once on this machine", preparing=True)
    observer, printed = observe(RunStarted(all_stale()), committed(simulate, 0), compiling, compiling)
    assert lines(printed) == ["simulate: compiling kernels, once on this machine"]
    observer.notify(Progress(simulate.id, 1, 1, FRAMES, "frame 1"))
    assert observer.stages["simulate"].message == "frame 1"


def test_the_time_left_of_all_is_known_once_every_stage_has_a_rate():
    simulate, render = (StageProgress(name, total=10, done=0) for name in ("simulate", "render"))
    for now in range(4):
        simulate.advance(1, float(now))
    assert remaining_of_all_s([simulate, render], 3.0) is None
    for now in range(4):
        render.advance(1, 2.0 * now)
    assert remaining_of_all_s([simulate, render], 6.0) == pytest.approx(6 / 0.5 + 6 / 0.5)
    render.advance(6, 8.0)
    assert remaining_of_all_s([simulate, render], 9.0) == pytest.approx(6 / (3 / 9.0))


def test_a_stage_says_what_it_makes_the_first_time():
    stream = io.StringIO()
    _, first, second, third, _ = film(FRAMES)
    with ProgressObserver(PlainDisplay(stream), {"render": "pictures"}) as observer:
        for event in (RunStarted(all_stale()), *map(committed, (first, second, third))):
            observer.notify(event)
    assert [line.partition(",")[0] for line in lines(stream.getvalue())] == [f"render (pictures) {FRAMES}/{FRAMES}"]


def test_a_terminal_shows_a_bar_for_the_job_and_for_every_stage():
    stream = io.StringIO()
    display = LiveDisplay(Console(file=stream, force_terminal=True, width=100), "my-film")
    with ProgressObserver(display, {"movie": "the film"}) as observer:
        observer.notify(RunStarted(all_stale()))
        simulate = film(FRAMES)[0]
        for index in range(FRAMES):
            observer.notify(committed(simulate, index))
        observer.notify(Notice("the disk is full"))
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue())
    assert re.search(rf"simulate .*{FRAMES}/{FRAMES}", shown)
    assert re.search(rf"movie .*0/{1} +the film", shown)
    assert re.search("my-film .* s so far", shown)
    assert "the disk is full" in shown


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (9.96, "10 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (7830, "2 h 10 min")],
)
def test_durations_read_well(seconds, text):
    assert wording.duration(seconds) == text


@pytest.mark.parametrize(
    ("byte_count", "text"),
    [(0, "0 bytes"), (1023, "1023 bytes"), (1024, "1.0 KiB"), (5 << 20, "5.0 MiB"), (3 << 40, "3072.0 GiB")],
)
def test_sizes_read_well(byte_count, text):
    assert wording.size(byte_count) == text


def test_durations_grow_with_their_texts():
    """No gap and no step back where one way of writing ends and the next begins."""
    texts = [wording.duration(tenths / 10) for tenths in range(0, 40_000)]
    assert len(set(texts)) == len(list(itertools.groupby(texts)))


def test_what_takes_minutes_once_is_said_at_once_and_by_one_of_those_who_wait():
    _, first, second, *_ = film(FRAMES)
    compiling = "compiling Cycles' kernels for NVIDIA H100; minutes, once"
    observer, printed = observe(
        RunStarted(all_stale()),
        Progress(first.id, 1, 0, 1, compiling, preparing=True),
        Progress(second.id, 1, 0, 1, compiling, preparing=True),
        Progress(first.id, 1, 0, 1, "", preparing=True),
        Progress(first.id, 1, 0, 1),
    )
    assert lines(printed) == [f"render: {compiling}"]
    assert observer.stages["render"].message == ""
