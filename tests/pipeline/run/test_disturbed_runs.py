"""Runs that somebody disturbs: who interrupts them, takes them over, or loses what they told or made."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from synthetic_jobs import Recorder, contents, job_text, run_recorded, run_synthetic
from synthetic_stages import write_faults

from pipeline.base.errors import FolderGoneError, JobBusyError, LeaseLostError
from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease
from pipeline.base.task import ArtifactPath, FailureKind, TaskId
from pipeline.record.manifest import Manifest
from pipeline.run.control import RunControl
from pipeline.run.events import Committed, Failed, Finished, JobOutcome, Notice, RunEvent, RunStarted, TaskEvent
from pipeline.run.executors.base import Assignment
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.executors.processes import ProcessExecutor


@pytest.fixture
def root(tmp_path) -> Path:
    return tmp_path / "job"


class Reacting(Recorder):
    """Does something whenever the run tells of an event of a kind."""

    def __init__(self, kind: type[RunEvent], act: Callable[[Any], None]) -> None:
        super().__init__()
        self.kind, self.act = kind, act

    def notify(self, event: RunEvent) -> None:
        super().notify(event)
        if isinstance(event, self.kind):
            self.act(event)


@pytest.mark.parametrize(("times", "kind"), [(1, JobOutcome.DRAINED), (2, JobOutcome.CANCELLED)])
def test_an_interrupted_run_is_continued_by_the_next(root, times, kind):
    write_faults(root, {}, pause_s=0.05)
    control = RunControl()

    def interrupt(commit: Committed) -> None:
        if commit.receipt.artifact == "steps/000002.bin":
            for _ in range(times):
                control.interrupt()

    interrupter = Reacting(Committed, interrupt)
    text = job_text(frames=40)  # two seconds of simulation: enough to be interrupted in
    with ProcessExecutor() as executor:
        outcome = run_synthetic(root, executor, text, observers=[interrupter.notify], control=control)
    assert (outcome.kind, outcome.exit_code, outcome.failures) == (kind, 130, ())
    done = {event.receipt.artifact for event in interrupter.of(Committed)}
    assert 3 <= len(done) < 81
    write_faults(root, {})
    outcome, recorder = run_recorded(root, text)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert not done & {event.receipt.artifact for event in recorder.of(Committed)}
    run_recorded(root.parent / "undisturbed", text)
    assert contents(root) == contents(root.parent / "undisturbed")


def test_a_job_that_runs_already_is_left_alone(root):
    root.mkdir()
    with Lease.acquire(JobLayout(root).lease), pytest.raises(JobBusyError, match=f"process {os.getpid()} "):
        run_recorded(root)
    assert not JobLayout(root).job_file.exists()


def test_the_lease_is_renewed_while_the_run_is_planned(root, monkeypatch):
    monkeypatch.setattr("pipeline.base.lease.HEARTBEAT_INTERVAL_S", 0.01)
    lease = JobLayout(root).lease

    def take_time_until_the_lease_is_renewed(_: RunStarted) -> None:
        os.utime(lease, (0, 0))
        until = time.monotonic() + 30.0
        while lease.stat().st_mtime == 0:
            assert time.monotonic() < until, "no heartbeat while the run is planned"
            time.sleep(0.01)

    with InlineExecutor() as executor:
        observer = Reacting(RunStarted, take_time_until_the_lease_is_renewed)
        outcome = run_synthetic(root, executor, observers=[observer.notify])
    assert outcome.kind is JobOutcome.SUCCEEDED


def test_a_run_whose_lease_was_taken_over_stops(root, monkeypatch):
    monkeypatch.setattr("pipeline.base.lease.HEARTBEAT_INTERVAL_S", 0.01)
    write_faults(root, {}, pause_s=0.1)
    lease = JobLayout(root).lease
    ours = [root / ".receipts/steps/.000005.bin.json.part.1", root / "steps/.000005.bin.part.1"]
    theirs = root / "steps/.000005.bin.part.2"

    def take_over_from_elsewhere(_: Committed) -> None:
        for part in (*ours, theirs):  # written by a call that hung until the other run had swept
            part.touch()
        holder = json.loads(lease.read_text())
        part = lease.with_name("new.lease")
        part.write_text(json.dumps(holder | {"token": "another", "host": "elsewhere"}))
        part.replace(lease)

    with InlineExecutor() as executor, pytest.raises(LeaseLostError, match=r"taken over by process \d+ on elsewhere"):
        run_synthetic(root, executor, observers=[Reacting(Committed, take_over_from_elsewhere).notify])
    assert lease.exists()
    assert ([part for part in ours if part.exists()], theirs.exists()) == ([], True)


@pytest.mark.parametrize("executor", [InlineExecutor, ProcessExecutor])
def test_a_run_whose_folder_is_renamed_stops_and_makes_no_new_one(root, executor):
    write_faults(root, {}, pause_s=0.02)
    renamed = root.with_name("renamed")

    def rename(commit: Committed) -> None:
        if commit.receipt.artifact == "steps/000002.bin":
            root.rename(renamed)

    observer = Reacting(Committed, rename)
    with executor() as running, pytest.raises(FolderGoneError, match="job is not there any more; if it was renamed"):
        run_synthetic(root, running, observers=[observer.notify])
    assert not root.exists()
    done = {event.receipt.artifact for event in observer.of(Committed)}
    write_faults(renamed, {})
    outcome, recorder = run_recorded(renamed)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert not done & {event.receipt.artifact for event in recorder.of(Committed)}
    run_recorded(root.with_name("undisturbed"))
    assert contents(renamed) == contents(root.with_name("undisturbed"))


def test_a_folder_that_is_gone_is_missed_at_the_next_heartbeat(root, monkeypatch):
    monkeypatch.setattr("pipeline.base.lease.HEARTBEAT_INTERVAL_S", 0.01)
    root.mkdir()
    with Lease.acquire(JobLayout(root).lease) as lease:
        lease.check()
        root.rename(root.with_name("renamed"))
        until = time.monotonic() + 30.0
        with pytest.raises(FolderGoneError):
            while time.monotonic() < until:
                lease.check()
                time.sleep(0.01)
    assert not root.exists()


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
def test_a_commit_whose_word_was_lost_is_adopted_and_not_made_again(root, kind):
    recorder = Recorder()
    with LosingExecutor("double/000002.bin", kind) as executor:
        outcome = run_synthetic(root, executor, observers=[recorder.notify])
    assert (outcome.kind, outcome.ran, outcome.failures) == (JobOutcome.SUCCEEDED, 8, ())
    assert executor.submitted.count(TaskId("double/000002")) == 1
    assert "double/000002.bin" in {event.receipt.artifact for event in recorder.of(Committed)}
    with Manifest(JobLayout(root).manifest) as manifest:
        (attempt,) = manifest.history(TaskId("double/000002"))
        assert (attempt.outcome, attempt.message) == ("succeeded", "after its last commit: killed")
    assert run_recorded(root)[1].ran() == []


def test_after_an_end_by_force_the_next_run_looks_for_receipts_that_nobody_told_of(root):
    write_faults(root, {"double/000001": ["segfault"]})
    with ProcessExecutor() as executor:
        run_synthetic(root, executor)
    with Manifest(JobLayout(root).manifest) as manifest:
        manifest.forget_artifacts([ArtifactPath("double/000003.bin")])
    _, recorder = run_recorded(root)
    assert recorder.ran() == []  # its receipt was adopted


def test_a_file_that_vanishes_while_its_task_ends_fails_the_task(root):
    """Its stage found the frames there; the record did not know of them, and one is gone before it is told."""
    run_recorded(root)
    with Manifest(JobLayout(root).manifest) as manifest:
        manifest.forget_artifacts(manifest.artifacts())

    def remove(end: Finished) -> None:
        if end.task_id == "steps":
            (root / "steps/000003.bin").unlink()

    with InlineExecutor() as executor:
        outcome = run_synthetic(root, executor, observers=[Reacting(Finished, remove).notify])
    assert outcome.kind is JobOutcome.FAILED
    assert "steps/000003.bin was there when its task ended" in outcome.failures[0].message
    assert run_recorded(root)[0].kind is JobOutcome.SUCCEEDED


def shred(manifest: Path) -> None:
    content = bytearray(manifest.read_bytes())
    content[4096:] = b"\xa5" * (len(content) - 4096)
    manifest.write_bytes(content)


def garble(manifest: Path) -> None:
    manifest.write_bytes(b"garbled")


def flip_a_bit_of_a_path(manifest: Path) -> None:
    """Found by reading alone: the file is sound to SQLite."""
    text = b"steps/000002.bin"
    content = manifest.read_bytes()
    assert text in content
    manifest.write_bytes(content.replace(text, bytes([text[0] | 0x80]) + text[1:]))


@pytest.mark.parametrize("damage", [shred, garble, flip_a_bit_of_a_path])
def test_a_damaged_record_is_made_anew_and_no_work_is_done_again(root, damage):
    run_recorded(root)
    for name in ("-wal", "-shm"):
        assert not Path(f"{JobLayout(root).manifest}{name}").exists()
    damage(JobLayout(root).manifest)
    outcome, recorder = run_recorded(root)
    assert (outcome.kind, recorder.ran()) == (JobOutcome.SUCCEEDED, [])
    told = recorder.of(Notice)[0].message
    assert "was damaged and is made anew of 13 receipts; the old one is" in told
    assert Path(told.rpartition(" ")[2]).exists()
    outcome, recorder = run_recorded(root)
    assert (recorder.of(Notice), recorder.ran()) == ([], [])
