"""Whole runs over the synthetic stages: what runs, what does not run again, and how faults end."""

from __future__ import annotations

import errno
import json
import os
import sqlite3
import time
from dataclasses import replace
from pathlib import Path

import pytest
from synthetic_jobs import Recorder, contents, job_text, run_synthetic
from synthetic_stages import FilmStage, write_faults

from pipeline.errors import JobBusyError, LeaseLostError, PlanError
from pipeline.executors.base import Assignment, Committed, Failed, Finished, TaskEvent
from pipeline.executors.inline import InlineExecutor
from pipeline.executors.processes import ProcessExecutor
from pipeline.layout import JobLayout
from pipeline.lease import Lease
from pipeline.manifest import Manifest
from pipeline.run_control import RunControl, Selection
from pipeline.run_events import Notice, Outcome, RunEnded, RunEvent, RunStarted
from pipeline.scheduler_events import JobOutcome, Policy
from pipeline.task import ArtifactPath, FailureKind, Resources, TaskId, TaskState

ALL = ["steps", *(f"double/{k:06d}" for k in range(6)), "film"]


def run(root: Path, text: str | None = None, **options: object) -> tuple[Outcome, Recorder]:
    recorder = Recorder()
    with InlineExecutor() as executor:
        return run_synthetic(root, executor, text, observer=recorder, **options), recorder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "job"


@pytest.fixture
def finished(root: Path) -> Path:
    run(root)
    return root


def test_a_new_job_runs_every_task_once(root: Path) -> None:
    outcome, recorder = run(root)
    assert (outcome.kind, outcome.exit_code, outcome.ran) == (JobOutcome.SUCCEEDED, 0, 8)
    assert sorted(recorder.ran()) == sorted(ALL)
    assert isinstance(recorder.events[0], RunStarted)
    assert recorder.events[-1] == RunEnded(outcome)
    with Manifest(JobLayout(root).manifest) as manifest:
        assert set(manifest.states().values()) == {TaskState.SUCCEEDED}
        assert len(manifest.artifacts()) == 13
        (attempt,) = manifest.history(TaskId("film"))
        assert attempt.outcome == "succeeded"
        assert attempt.peak_memory_bytes > 0


def test_a_finished_job_has_nothing_to_do(finished: Path) -> None:
    before = contents(finished)
    outcome, recorder = run(finished)
    assert (outcome.kind, outcome.ran) == (JobOutcome.SUCCEEDED, 0)
    assert recorder.ran() == []
    assert contents(finished) == before


def test_processes_give_the_same_bytes_as_inline(finished: Path, tmp_path: Path) -> None:
    with ProcessExecutor() as executor:
        assert run_synthetic(tmp_path / "other", executor).kind is JobOutcome.SUCCEEDED
    assert contents(tmp_path / "other") == contents(finished)


def test_a_later_stage_starts_while_the_simulation_runs(root: Path) -> None:
    write_faults(root, {"steps": ["wait for reader@5"]})
    recorder = Recorder()
    with ProcessExecutor() as executor:
        assert run_synthetic(root, executor, observer=recorder).kind is JobOutcome.SUCCEEDED
    order = [event.receipt.artifact for event in recorder.of(Committed)]
    assert order.index("double/000000.bin") < order.index("steps/000005.bin")


def test_a_changed_camera_reruns_only_what_reads_it(finished: Path) -> None:
    _, recorder = run(finished, job_text(focal_length_mm=35.0))
    assert recorder.ran() == [name for name in ALL if name != "steps"]


def test_a_longer_film_continues_the_simulation(finished: Path) -> None:
    _, recorder = run(finished, job_text(frames=8))
    assert recorder.ran() == ["steps", "double/000006", "double/000007", "film"]
    assert [e.receipt.artifact for e in recorder.of(Committed) if e.task_id == "steps"] == [
        "steps/000006.bin",
        "steps/000007.bin",
    ]


def test_what_turns_out_the_same_stops_the_rebuild_there(finished: Path) -> None:
    """Early cutoff: a lost file is made anew with the same bytes, so nobody who read it runs."""
    (finished / "steps/000002.bin").unlink()
    outcome, recorder = run(finished)
    assert recorder.ran() == ["steps"]
    assert outcome.counts["double", TaskState.UP_TO_DATE] == 6


def test_a_truncated_artifact_is_made_anew(finished: Path) -> None:
    whole = contents(finished)
    os.truncate(finished / "double/000003.bin", 10)
    _, recorder = run(finished)
    assert recorder.ran() == ["double/000003"]
    assert contents(finished) == whole


def test_an_edited_artifact_is_kept_aside_and_that_is_said(finished: Path) -> None:
    (finished / "double/000003.bin").write_bytes(b"painted over by hand")
    _, recorder = run(finished)
    assert (finished / "double/000003.bin.edited-1").read_bytes() == b"painted over by hand"
    assert any("double/000003.bin.edited-1" in notice.message for notice in recorder.of(Notice))


def test_selected_frames_run_again(finished: Path) -> None:
    _, recorder = run(finished, rerun=Selection(frozenset({"double"}), frozenset({1, 2})))
    assert recorder.ran() == ["double/000001", "double/000002"]


def test_a_selected_simulation_runs_again_from_the_start(finished: Path) -> None:
    _, recorder = run(finished, rerun=Selection(frozenset({"steps"})))
    assert recorder.ran() == ["steps"]
    assert len([e for e in recorder.of(Committed) if e.task_id == "steps"]) == 6


def test_an_edited_file_is_kept_aside_on_request_of_a_rerun_too(finished: Path) -> None:
    (finished / "double/000003.bin").write_bytes(b"painted over by hand")
    run(finished, rerun=Selection(frozenset({"double"})))
    assert (finished / "double/000003.bin.edited-1").read_bytes() == b"painted over by hand"


@pytest.mark.parametrize(
    ("selection", "complaint"),
    [
        (
            Selection(frozenset({"double", "doubel", "sumilate"})),
            'no stage "doubel" in this job; did you mean "double"?; no stage "sumilate" in this job; '
            "the stages are steps, double, film",
        ),
        (
            Selection(frozenset({"double"}), frozenset({1, 6, 7, 9})),
            "no frame 6-7, 9 in this job; the frames are 0-5",
        ),
        (Selection(frames=frozenset({99})), "no frame 99 in this job; the frames are 0-5"),
        (
            Selection(frozenset({"steps", "double"}), frozenset({1})),
            "steps: about the whole job, has no frames to choose from; leave them out",
        ),
    ],
)
def test_a_selection_of_what_is_not_there_is_refused(finished: Path, selection: Selection, complaint: str) -> None:
    with pytest.raises(PlanError) as refused:
        run(finished, rerun=selection)
    assert str(refused.value) == complaint
    with Manifest.open_readonly(JobLayout(finished).manifest) as manifest:
        assert manifest.last_run().outcome == JobOutcome.SUCCEEDED


def test_a_failed_frame_is_told_and_runs_next_time(root: Path) -> None:
    write_faults(root, {"double/000002": ["fail"]})
    outcome, _ = run(root)
    assert (outcome.kind, outcome.exit_code) == (JobOutcome.FAILED, 5)
    assert [(f.task_id, f.kind) for f in outcome.failures] == [("double/000002", FailureKind.FAILED)]
    assert outcome.counts["film", TaskState.UPSTREAM_FAILED] == 1
    outcome, recorder = run(root)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert recorder.ran() == ["double/000002", "film"]


def test_a_diverged_simulation_is_told_as_such(root: Path) -> None:
    write_faults(root, {"steps": ["diverge@3"]})
    outcome, recorder = run(root)
    assert outcome.failures[0].kind is FailureKind.DIVERGED
    assert recorder.ran() == ["double/000000", "double/000001", "double/000002"]


def test_a_lost_worker_is_retried_within_the_run(root: Path) -> None:
    write_faults(root, {"steps": ["kill@3"], "double/000001": ["segfault"]})
    recorder = Recorder()
    with ProcessExecutor() as executor:
        outcome = run_synthetic(root, executor, observer=recorder)
    assert (outcome.kind, outcome.failures) == (JobOutcome.SUCCEEDED, ())
    assert sorted(event.task_id for event in recorder.of(Failed)) == ["double/000001", "steps"]
    assert len([e for e in recorder.of(Committed) if e.task_id == "steps"]) == 6  # each frame once, over two attempts
    assert list(root.rglob(".*.part.*")) == []


def test_a_full_disk_pauses_the_job_and_the_next_run_finishes_it(root: Path) -> None:
    write_faults(root, {"double/000002": ["disk full"]})
    outcome, recorder = run(root)
    assert (outcome.kind, outcome.failures) == (JobOutcome.DISK_FULL, ())
    assert any("disk is full" in notice.message for notice in recorder.of(Notice))
    outcome, recorder = run(root)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert "double/000001" not in recorder.ran()


def test_a_manifest_on_a_full_disk_loses_nothing(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record_artifact = Manifest.record_artifact

    def full_at_the_third_frame(self: Manifest, receipt: object) -> None:
        if "000002" in receipt.artifact:  # type: ignore[attr-defined]
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        record_artifact(self, receipt)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(Manifest, "record_artifact", full_at_the_third_frame)
        assert run(root)[0].kind is JobOutcome.DISK_FULL
    outcome, recorder = run(root)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert "steps" not in recorder.ran()  # its receipts told the record what it had missed


def test_too_many_failures_stop_the_job(root: Path) -> None:
    write_faults(root, {f"double/{k:06d}": ["fail"] for k in range(6)})
    outcome, _ = run(root, policy=Policy(failure_count=3), capacity=Resources(cores=1))
    assert outcome.kind is JobOutcome.TOO_MANY_FAILURES
    assert len(outcome.failures) == 3


class Interrupter(Recorder):
    """Interrupts the run at an artifact, as Ctrl-C would."""

    def __init__(self, control: RunControl, artifact: str, times: int) -> None:
        super().__init__()
        self.control, self.artifact, self.times = control, artifact, times

    def notify(self, event: RunEvent) -> None:
        super().notify(event)
        if isinstance(event, Committed) and event.receipt.artifact == self.artifact:
            for _ in range(self.times):
                self.control.interrupt()


@pytest.mark.parametrize(("times", "kind"), [(1, JobOutcome.DRAINED), (2, JobOutcome.CANCELLED)])
def test_an_interrupted_run_is_continued_by_the_next(root: Path, times: int, kind: JobOutcome) -> None:
    write_faults(root, {}, pause_s=0.05)
    control = RunControl()
    interrupter = Interrupter(control, "steps/000002.bin", times)
    text = job_text(frames=40)  # two seconds of simulation: enough to be interrupted in
    with ProcessExecutor() as executor:
        outcome = run_synthetic(root, executor, text, observer=interrupter, control=control)
    assert (outcome.kind, outcome.exit_code, outcome.failures) == (kind, 130, ())
    done = {event.receipt.artifact for event in interrupter.of(Committed)}
    assert 3 <= len(done) < 81
    write_faults(root, {})
    outcome, recorder = run(root, text)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert not done & {event.receipt.artifact for event in recorder.of(Committed)}
    run(root.parent / "undisturbed", text)
    assert contents(root) == contents(root.parent / "undisturbed")


def test_a_job_that_runs_already_is_left_alone(root: Path) -> None:
    root.mkdir()
    with Lease.acquire(JobLayout(root).lease), pytest.raises(JobBusyError, match=f"process {os.getpid()} "):
        run(root)
    assert not JobLayout(root).job_file.exists()


def test_a_lost_manifest_is_made_anew_of_the_receipts(finished: Path) -> None:
    JobLayout(finished).manifest.unlink()
    _, recorder = run(finished)
    assert recorder.ran() == []


def test_the_manifest_is_whole_after_a_run(finished: Path) -> None:
    with sqlite3.connect(JobLayout(finished).manifest) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []


class LosingExecutor(InlineExecutor):
    """Loses all word of one commit: the worker is killed between the receipt and the message."""

    def __init__(self, artifact: str, kind: FailureKind) -> None:
        super().__init__()
        self.artifact, self.kind = artifact, kind
        self.lost: TaskId | None = None
        self.submitted: list[TaskId] = []

    def submit(self, assignment: Assignment) -> None:
        self.submitted.append(assignment.task.id)
        super().submit(assignment)

    def wait(self, timeout_s: float) -> list[TaskEvent]:
        events: list[TaskEvent] = []
        for event in super().wait(timeout_s):
            if isinstance(event, Committed) and event.receipt.artifact == self.artifact:
                self.lost = event.task_id
                events.append(Failed(event.task_id, event.attempt, self.kind, "killed"))
            elif event.task_id != self.lost:
                events.append(event)
        return events


@pytest.mark.parametrize("kind", [FailureKind.WORKER_LOST, FailureKind.STALLED, FailureKind.CANCELLED])
def test_a_commit_whose_word_was_lost_is_adopted_and_not_made_again(root: Path, kind: FailureKind) -> None:
    recorder = Recorder()
    with LosingExecutor("double/000002.bin", kind) as executor:
        outcome = run_synthetic(root, executor, observer=recorder)
    assert (outcome.kind, outcome.ran, outcome.failures) == (JobOutcome.SUCCEEDED, 8, ())
    assert executor.submitted.count(TaskId("double/000002")) == 1
    assert "double/000002.bin" in {event.receipt.artifact for event in recorder.of(Committed)}
    with Manifest(JobLayout(root).manifest) as manifest:
        (attempt,) = manifest.history(TaskId("double/000002"))
        assert (attempt.outcome, attempt.message) == ("succeeded", "after its last commit: killed")
    assert run(root)[1].ran() == []


def test_after_an_end_by_force_the_next_run_looks_for_receipts_that_nobody_told_of(root: Path) -> None:
    write_faults(root, {"double/000001": ["segfault"]})
    with ProcessExecutor() as executor:
        run_synthetic(root, executor)
    with Manifest(JobLayout(root).manifest) as manifest:
        manifest.forget_artifacts([ArtifactPath("double/000003.bin")])
    _, recorder = run(root)
    assert recorder.ran() == []  # its receipt was adopted


class Vandal(Recorder):
    """Removes a file at the moment that its task ends."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def notify(self, event: RunEvent) -> None:
        super().notify(event)
        if isinstance(event, Finished) and event.task_id == "steps":
            self.path.unlink()


def test_a_file_that_vanishes_while_its_task_ends_fails_the_task(finished: Path) -> None:
    """Its stage found the frames there; the record did not know of them, and one is gone before it is told."""
    with Manifest(JobLayout(finished).manifest) as manifest:
        manifest.forget_artifacts(manifest.artifacts())
    vandal = Vandal(finished / "steps/000003.bin")
    with InlineExecutor() as executor:
        outcome = run_synthetic(finished, executor, observer=vandal)
    assert outcome.kind is JobOutcome.FAILED
    assert "steps/000003.bin was there when its task ended" in outcome.failures[0].message
    assert run(finished)[0].kind is JobOutcome.SUCCEEDED


class Planner(Recorder):
    """Takes its time between the plan and the first task, until the lease has been renewed."""

    def __init__(self, lease: Path) -> None:
        super().__init__()
        self.lease = lease

    def notify(self, event: RunEvent) -> None:
        super().notify(event)
        if isinstance(event, RunStarted):
            os.utime(self.lease, (0, 0))
            until = time.monotonic() + 30.0
            while self.lease.stat().st_mtime == 0:
                assert time.monotonic() < until, "no heartbeat while the run is planned"
                time.sleep(0.01)


def test_the_lease_is_renewed_while_the_run_is_planned(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.lease.HEARTBEAT_INTERVAL_S", 0.01)
    with InlineExecutor() as executor:
        outcome = run_synthetic(root, executor, observer=Planner(JobLayout(root).lease))
    assert outcome.kind is JobOutcome.SUCCEEDED


class Usurper(Recorder):
    """Takes the job over after its first commit, as a runner on another machine would."""

    def __init__(self, lease: Path) -> None:
        super().__init__()
        self.lease = lease

    def notify(self, event: RunEvent) -> None:
        super().notify(event)
        if isinstance(event, Committed):
            holder = json.loads(self.lease.read_text())
            part = self.lease.with_name("new.lease")
            part.write_text(json.dumps(holder | {"token": "another", "host": "elsewhere"}))
            part.replace(self.lease)


def test_a_run_whose_lease_was_taken_over_stops(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.lease.HEARTBEAT_INTERVAL_S", 0.01)
    write_faults(root, {}, pause_s=0.1)
    with InlineExecutor() as executor, pytest.raises(LeaseLostError, match=r"taken over by process \d+ on elsewhere"):
        run_synthetic(root, executor, observer=Usurper(JobLayout(root).lease))
    assert JobLayout(root).lease.exists()


def test_the_record_says_how_each_run_ended(root: Path) -> None:
    write_faults(root, {"double/000002": ["fail"]})
    run(root)
    with Manifest.open_readonly(JobLayout(root).manifest) as manifest:
        failed = manifest.last_run()
    run(root)
    with Manifest.open_readonly(JobLayout(root).manifest) as manifest:
        succeeded = manifest.last_run()
    assert (failed.outcome, succeeded.outcome) == (JobOutcome.FAILED, JobOutcome.SUCCEEDED)
    assert failed.run != succeeded.run


def test_what_no_machine_has_is_a_clear_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = FilmStage.plan
    on_gpu = Resources(gpus=1)
    monkeypatch.setattr(FilmStage, "plan", lambda *args: [replace(task, resources=on_gpu) for task in plan(*args)])
    with InlineExecutor() as executor, pytest.raises(PlanError, match="film needs 1 GPUs"):
        run_synthetic(tmp_path / "job", executor)
