"""Parts of the dashboard: glances at records, estimates, places, small pictures."""

import os
import struct
import threading
import time
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from dashboards import draw_frame, frame_job

from pipeline.base.errors import ManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.lease import LeaseHolder
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import FailureKind, Task, TaskId, TaskState
from pipeline.queue.job_queue import JobQueue
from pipeline.queue.states import JobState
from pipeline.record.glance import glance
from pipeline.record.manifest import Manifest
from pipeline.record.reader import ManifestReader, StagePace, StageSummary
from pipeline.record.reconcile import rebuild_manifest
from pipeline.web.dashboard.actions import Queue, actions_of
from pipeline.web.dashboard.estimates import LongTask, remaining, stage_rows
from pipeline.web.dashboard.farm_view import SETTLED_S, FarmView, Kept, read_record
from pipeline.web.dashboard.machine import Machine
from pipeline.web.dashboard.places import NotThereError, Places
from pipeline.web.dashboard.thumbnails import Thumbnails


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    return JobLayout(tmp_path / "film")


# --- glances ---
def test_a_glance_makes_no_file_and_sees_what_a_runner_wrote_last(layout: JobLayout) -> None:
    tasks = frame_job(layout, 3)
    before = sorted(layout.root.iterdir())
    assert len(glance(layout.manifest, ManifestReader.states)) == 3
    assert sorted(layout.root.iterdir()) == before
    with Manifest(layout.manifest) as manifest:
        manifest.set_states({tasks[1].id: TaskState.RUNNING})
        assert glance(layout.manifest, ManifestReader.states)[tasks[1].id] is TaskState.RUNNING


def test_a_record_that_changes_during_a_glance_is_read_once_more(layout: JobLayout) -> None:
    tasks = frame_job(layout, 3)
    seen = []

    def query(manifest: ManifestReader) -> TaskState:
        seen.append(manifest.states()[tasks[0].id])
        if len(seen) == 1:
            with Manifest(layout.manifest) as runner:
                runner.set_states({tasks[0].id: TaskState.FAILED})
        return seen[-1]

    assert glance(layout.manifest, query) is TaskState.FAILED
    assert seen == [TaskState.PENDING, TaskState.FAILED]


def test_a_record_that_is_damaged_is_so_after_one_try(layout: JobLayout) -> None:
    frame_job(layout, 3)
    layout.manifest.write_bytes(b"SQLite format 3\0" + bytes(4096))
    with pytest.raises(ManifestError, match="damaged"):
        glance(layout.manifest, ManifestReader.states)


def test_readers_in_many_threads_never_keep_a_runner_from_writing(layout: JobLayout) -> None:
    tasks = frame_job(layout, 200)
    ended, counts = threading.Event(), []

    def look() -> None:
        while not ended.is_set():
            counts.append(glance(layout.manifest, lambda manifest: read_record(manifest, runs=True)).stages[0].total)

    threads = [threading.Thread(target=look) for _ in range(4)]
    for thread in threads:
        thread.start()
    for task in tasks[:40]:
        with Manifest(layout.manifest) as manifest:  # opened and closed again: its log comes and goes
            number = manifest.start_attempt(task.id)
            manifest.finish_attempt(task.id, number, state=TaskState.SUCCEEDED)
    ended.set()
    for thread in threads:
        thread.join()
    assert set(counts) == {200}
    assert glance(layout.manifest, lambda manifest: read_record(manifest, runs=False)).stages[0].done == 40


def test_a_page_of_tasks_has_their_last_attempts_in_the_order_of_the_plan(layout: JobLayout) -> None:
    tasks = frame_job(layout, 30)
    with Manifest(layout.manifest) as manifest:
        for failure in (FailureKind.TIMED_OUT, FailureKind.FAILED):
            number = manifest.start_attempt(tasks[12].id)
            manifest.finish_attempt(tasks[12].id, number, failure=failure, message=failure, state=TaskState.FAILED)
        page = manifest.task_page(limit=10, offset=10)
        assert ([row.task for row in page.rows], page.total) == ([task.id for task in tasks[10:20]], 30)
        assert (page.rows[2].attempt, page.rows[2].message) == (2, "failed")
        assert page.rows[3].attempt is None
        assert [row.task for row in manifest.task_page(states=(TaskState.FAILED,)).rows] == [tasks[12].id]
        assert manifest.task_page(text="00001").total == 11
        assert manifest.task_page(text="%").total == manifest.task_page(stage="other").total == 0


def test_the_newest_frames_come_first_and_only_those_right_in_the_folder(layout: JobLayout) -> None:
    tasks = frame_job(layout, 5)
    with Manifest(layout.manifest) as manifest:
        for k in (1, 3, 0):
            draw_frame(layout, manifest, tasks[k])
        found = manifest.newest_in("frames", ".png", limit=2)
        assert [file.path for file in found] == ["frames/000000.png", "frames/000003.png"]
        assert manifest.newest_and_count_in("frames", ".png") == (found[0], 3)
        assert (
            manifest.newest_and_count_in("frame", ".png") == manifest.newest_and_count_in("frames", ".exr") == (None, 0)
        )


def test_files_of_an_earlier_run_are_old_until_they_are_made_anew(layout: JobLayout) -> None:
    tasks = frame_job(layout, 3)
    other = Task(TaskId("simulate"), "simulate", (), (), ParameterSet.of(stage="simulate", version=1, tools={}))

    def old() -> list[str]:
        return sorted(Path(file.path).stem for file in manifest.newest_in("frames", ".png", limit=9) if file.is_old)

    with Manifest(layout.manifest) as manifest:
        for task in tasks:
            draw_frame(layout, manifest, task)
        assert old() == []
        manifest.set_states({tasks[1].id: TaskState.PENDING})
        assert old() == ["000001"]
        assert manifest.is_old(tasks[1].outputs[0]) and not manifest.is_old(tasks[0].outputs[0])
        manifest.record_plan([other])  # of another goal, which says nothing about frames
        assert old() == []
        manifest.record_plan(tasks[:2])  # the job has become shorter
        manifest.set_states({tasks[0].id: TaskState.FAILED})
        assert "000002" in old() and "000000" in old()
        newest, count = manifest.newest_and_count_in("frames", ".png")
        assert newest is not None and (newest.path, newest.is_old, count) == ("frames/000002.png", True, 3)


def test_a_stage_s_pace_is_that_of_its_attempts_and_its_work_that_of_a_span(layout: JobLayout) -> None:
    tasks = frame_job(layout, 5)
    with Manifest(layout.manifest) as manifest:
        assert manifest.stage_paces(0.0, 1e10) == {}
        for k, failure in enumerate((None, None, FailureKind.FAILED)):
            number = manifest.start_attempt(tasks[k].id)
            manifest.finish_attempt(tasks[k].id, number, failure=failure, seconds=2.0 + 2.0 * k)
        manifest.start_attempt(tasks[3].id)
        for k, (started, finished) in enumerate(((0.0, 90.0), (95.0, 110.0), (104.0, 109.0), (108.0, None))):
            manifest._connection.execute(
                "UPDATE attempt SET started = ?, finished = ? WHERE task = ?", (started, finished, tasks[k].id)
            )
        [pace] = manifest.stage_paces(100.0, 112.0).values()
    assert pace.mean_seconds == 3.0
    assert (pace.busy_s, pace.busy_since) == (10.0 + 5.0 + 4.0, 100.0)


def test_an_unchanged_farm_costs_no_reading_of_records(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pipeline.web.dashboard import farm_view

    for name in ("one", "two", "three"):
        frame_job(JobLayout(tmp_path / name), 3)
    read: list[str] = []

    def counting(path: Path, query: Any) -> Any:
        read.append(path.parent.name)
        return glance(path, query)

    monkeypatch.setattr(farm_view, "glance", counting)
    view = FarmView(Places(tmp_path), JobQueue(tmp_path))

    def looks(count: int) -> list[str]:
        read.clear()
        for _ in range(count):
            view.kept.forget()
            view.glance()
        return sorted(read)

    now = (
        time.time() + 2.0 * SETTLED_S
    )  # what was just written may change again within a tick of the file system's clock
    monkeypatch.setattr(farm_view.time, "time", lambda: now)
    assert looks(1) == ["one", "three", "two"]
    assert looks(20) == []
    with Manifest(JobLayout(tmp_path / "two").manifest) as manifest:
        manifest.log_event("test", "something")
    assert looks(1) == ["two"]


def test_a_job_that_never_ran_has_not_started_and_one_that_lost_its_record_was_interrupted(tmp_path: Path) -> None:
    names = ("new", "unrecorded", "rebuilt", "film", "take")
    new, unrecorded, rebuilt, film, take = (JobLayout(tmp_path / name) for name in names)
    [task, *_] = frame_job(rebuilt, 3)
    with Manifest(rebuilt.manifest) as manifest:
        draw_frame(rebuilt, manifest, task)
    rebuild_manifest(rebuilt)
    for layout in (new, unrecorded, film, take):
        layout.root.mkdir()
        layout.job_file.touch()
    for layout in (new, take):  # the record of a recording that crashed is empty
        Manifest(layout.manifest).close()
    for made in (film.path(film.picture(0)), film.path(film.movie()), take.path(take.frame_cache(0))):
        made.parent.mkdir(exist_ok=True)
        made.touch()
    view = FarmView(Places(tmp_path), JobQueue(tmp_path))
    not_started = dict.fromkeys(("new", "unrecorded"), JobState.NOT_STARTED)
    interrupted = dict.fromkeys(("rebuilt", "film", "take"), JobState.INTERRUPTED)
    assert {card.name: card.state for card in view.glance().jobs} == not_started | interrupted
    assert [action.label for action in actions_of(view.job("new"), has_runner=False)] == ["Start"]


# --- estimates ---
def test_what_is_left_is_shared_by_those_that_work_beside_each_other() -> None:
    summaries = [StageSummary("render", {TaskState.SUCCEEDED: 10, TaskState.RUNNING: 2, TaskState.PENDING: 8})]
    paces = {"render": StagePace("render", 6.0)}
    rows = stage_rows(summaries, paces, {}, {"render": 240.0}, 120.0)
    assert rows[0].work_s == 60.0  # ten of six seconds
    assert rows[0].remaining_s == 30.0  # two at once
    left = remaining(rows, {"render": 240.0}, 120.0)
    assert left is not None
    assert (left.seconds, left.at_least) == (30.0, False)


def test_a_stage_without_a_pace_makes_it_at_least() -> None:
    summaries = [
        StageSummary("render", {TaskState.SUCCEEDED: 1, TaskState.RUNNING: 1}),
        StageSummary("movie", {TaskState.PENDING: 1}),
    ]
    left = remaining(stage_rows(summaries, {"render": StagePace("render", 6.0)}, {}, {}, 0.0), {}, 0.0)
    assert left is not None
    assert (left.seconds, left.at_least) == (6.0, True)
    assert remaining(stage_rows(summaries[1:], {}, {}, {}, 0.0), {}, 0.0) is None


def test_a_simulation_is_as_far_as_its_frames_and_as_fast_as_this_attempt() -> None:
    continued = LongTask(made=60, made_now=10, of=100, elapsed_s=20.0)
    assert (continued.share, continued.remaining_s) == (0.6, 80.0)
    assert continued._replace(made_now=1).remaining_s is None
    [row] = stage_rows([StageSummary("simulate", {TaskState.RUNNING: 1})], {}, {"simulate": continued}, {}, 0.0)
    assert (row.share, row.frames, row.remaining_s) == (0.6, (60, 100), 80.0)


def test_what_failed_is_no_work_that_is_left() -> None:
    counts = {TaskState.SUCCEEDED: 1, TaskState.FAILED: 2, TaskState.UPSTREAM_FAILED: 3}
    [row] = stage_rows([StageSummary("render", counts)], {"render": StagePace("render", 6.0)}, {}, {}, 0.0)
    assert (row.done, row.failed, row.blocked, row.work_s) == (1, 2, 3, 0.0)


def test_a_long_task_is_known_by_the_record_of_its_job(layout: JobLayout) -> None:
    from large_jobs import build, plan

    build(layout, plan(21), 0.0, runs=True)
    with Manifest(layout.manifest) as manifest:
        assert manifest.artifacts_of(TaskId("simulate")) == (0, 0)
        assert manifest.frame_count() == 10
        record = read_record(manifest, runs=True)
    assert sum(stage.running for stage in record.stages) == len(record.running) == 8
    at_rest = glance(layout.manifest, lambda manifest: read_record(manifest, runs=False))
    assert all(stage.running == 0 for stage in at_rest.stages)


def test_many_who_ask_at_once_find_out_once() -> None:
    asked: list[int] = []
    kept = Kept(lambda: asked.append(1) or len(asked), 3600.0)
    threads = [threading.Thread(target=kept.get) for _ in range(20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert asked == [1]
    kept.forget()
    assert kept.get() == 2


def test_the_load_is_told_to_whatever_thread_asks(tmp_path: Path) -> None:
    machine, told = Machine(tmp_path), []
    until = time.monotonic() + 0.5
    while time.monotonic() < until:
        pass  # one core at least is busy
    asking = threading.Thread(target=lambda: told.append(machine.load()))
    asking.start()
    asking.join()
    # Half of that, as somebody else may have had the core.
    assert told[0].processor > 0.5 / told[0].cores


def test_the_cores_of_a_process_do_not_depend_on_how_many_ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine, holder = Machine(tmp_path), LeaseHolder.this_process()
    now, spent = [100.0], [7.0]
    monkeypatch.setattr("pipeline.web.dashboard.machine.time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(psutil.Process, "cpu_times", lambda _: SimpleNamespace(user=spent[0], system=0.0))
    monkeypatch.setattr(psutil.Process, "children", lambda _, **_options: [])

    def cores() -> float:
        return machine.processes(holder)[0].cores

    assert cores() == 0.0
    now[0], spent[0] = 101.0, 9.0
    assert cores() == 2.0
    now[0] = 101.001  # another tab, before the process's count has gone on
    assert cores() == 2.0
    now[0], spent[0] = 102.0, 9.5
    assert cores() == 0.5


# --- runners ---
def test_presses_at_once_start_one_runner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started, all_press = [], threading.Barrier(4)

    def start(_: JobQueue) -> int:
        time.sleep(0.05)  # as long as a press of somebody else needs
        started.append(os.getpid())
        return os.getpid()

    monkeypatch.setattr("pipeline.web.dashboard.actions.start_in_background", start)
    queue, told = Queue(JobQueue(tmp_path)), []

    def press() -> None:
        all_press.wait()
        told.append(queue.run())

    threads = [threading.Thread(target=press) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(started) == 1
    assert told.count("; a runner is starting") == 3
    assert queue.is_starting


# --- places ---
@pytest.mark.parametrize("name", ["", ".", "..", ".farm", "a/b", "../a", "a\0b", "nobody", "x" * 300, "\ud800"])
def test_names_that_are_no_job_lead_nowhere(tmp_path: Path, name: str) -> None:
    (tmp_path / "farm" / "a" / "b").mkdir(parents=True)
    (tmp_path / "farm" / ".farm").mkdir()
    with pytest.raises(NotThereError):
        Places(tmp_path / "farm").job(name)


@pytest.mark.parametrize(
    "relative", ["", ".", "..", "../b/file", "/etc/hostname", "a\0b", "folder", "loop", "out", "fi\nle"]
)
def test_paths_out_of_a_job_lead_nowhere(tmp_path: Path, relative: str) -> None:
    for name in ("a", "b"):
        (tmp_path / name / "folder").mkdir(parents=True)
        (tmp_path / name / "file").write_text("content")
    (tmp_path / "a" / "loop").symlink_to("loop")
    (tmp_path / "a" / "out").symlink_to(tmp_path / "b" / "file")
    places = Places(tmp_path)
    assert places.file("a", "file") == tmp_path / "a" / "file"
    with pytest.raises(NotThereError):
        places.file("a", relative)


def test_the_end_of_a_log_begins_with_a_line(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "log").write_text("first\nsecond\nthird ü\n")
    assert Places(tmp_path).tail("a", "log", 1000) == ("first\nsecond\nthird ü\n", 22)
    assert Places(tmp_path).tail("a", "log", 12)[0] == "third ü\n"


# --- small pictures ---
def test_a_small_picture_is_made_once_and_none_of_a_picture_that_is_too_large(
    layout: JobLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    [task] = frame_job(layout, 1)
    with Manifest(layout.manifest) as manifest:
        path = draw_frame(layout, manifest, task)
    thumbnails = Thumbnails()
    assert thumbnails.get(path, "small") is thumbnails.get(path, "small")
    monkeypatch.setattr("pipeline.web.dashboard.thumbnails.MOST_PIXELS", 1000)
    with pytest.raises(NotThereError, match="too large"):
        thumbnails.get(path, "large")


def test_a_picture_that_claims_to_be_vast_is_not_shown(tmp_path: Path) -> None:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", 30_000, 30_000, 8, 2, 0, 0, 0)
    vast = tmp_path / "000000.png"
    vast.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"") + chunk(b"IEND", b""))
    with pytest.raises(NotThereError, match="too large"):
        Thumbnails().get(vast, "small")
