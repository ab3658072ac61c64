"""A farm's runner among troubles: busy folders, disks that refuse, jobs that change or go while another one runs."""

import errno
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from command_line import pipeline
from synthetic_jobs import job_text

from pipeline.base.errors import DiskFullError, JobBusyError, LeaseLostError, PipelineError
from pipeline.base.lease import Lease
from pipeline.job.loading import job_of_text
from pipeline.queue.farm import Ended, FarmControl, FarmRunner, StopReason, TakeOver, start_in_background
from pipeline.queue.job_queue import Desired, JobQueue, QueuedJob, new_entry
from pipeline.queue.submitting import QueueOptions
from pipeline.queue.submitting import run as run_command
from pipeline.queue.turns import Turns, exit_code_of
from pipeline.run.events import JobOutcome, Outcome, RunEnded, RunStarted

Run = Callable[[QueuedJob, FarmControl], JobOutcome]
DONE = JobOutcome.SUCCEEDED
MANY_LOOKS = 100_000


@pytest.fixture
def queue(tmp_path, monkeypatch) -> JobQueue:
    monkeypatch.setattr("pipeline.queue.farm.LOOK_INTERVAL_S", 0.001)
    monkeypatch.setattr("pipeline.queue.farm.BUSY_RETRY_S", 0.01)
    return JobQueue(tmp_path)


def work(
    queue: JobQueue, run: Run, *, submission: str | None = None, told: list[tuple[str, Ended]] | None = None
) -> Ended | None:
    def run_job(job: QueuedJob, control: FarmControl, _observer: TakeOver) -> Outcome:
        return Outcome(run(job, control))

    def after_turn(name: str, _folder: Path, ended: Ended) -> None:
        if told is not None:
            told.append((name, ended))

    queue.make()
    with Lease.acquire(queue.lease) as lease:
        return FarmRunner(queue, lease, run_job, print, after_turn, submission=submission).work()


def until_stopped(control: FarmControl) -> JobOutcome:
    """Work on until the farm stops it, or has looked often enough."""
    for _ in range(MANY_LOOKS):
        if control.interruptions:
            return JobOutcome.DRAINED
    return DONE


def test_an_urgent_job_whose_folder_was_busy_goes_first_as_soon_as_it_is_free(queue, monkeypatch):
    monkeypatch.setattr("pipeline.queue.farm.BUSY_RETRY_S", 3600.0)
    queue.put(new_entry("low", text="x"))
    queue.put(new_entry("urgent", text="x", priority=9))
    folder = queue.layout("urgent").root
    folder.mkdir()
    cleaning = Lease.acquire(queue.layout("urgent").lease)
    turns: list[str] = []

    def run(job: QueuedJob, control: FarmControl) -> JobOutcome:
        turns.append(job.name)
        if turns == ["urgent"]:
            raise JobBusyError("urgent is being cleaned")
        if job.name == "urgent":
            return DONE
        if turns == ["urgent", "low"]:
            assert control.interruptions == 0
            cleaning.release()
        return until_stopped(control)

    work(queue, run)
    assert turns == ["urgent", "low", "urgent", "low"]


@pytest.mark.parametrize(
    ("number", "desired", "error", "note"),
    [
        (errno.EIO, Desired.NONE, PipelineError, os.strerror(errno.EIO)),
        (errno.ENOSPC, Desired.PAUSE, DiskFullError, "the disk is full"),
    ],
)
def test_a_folder_that_refuses_ends_the_turn_of_its_job_alone(queue, number, desired, error, note):
    queue.put(new_entry("a", text="x", priority=1))
    queue.put(new_entry("b", text="x"))
    told: list[tuple[str, Ended]] = []

    def run(job: QueuedJob, _control: FarmControl) -> JobOutcome:
        if job.name == "a":
            raise OSError(number, os.strerror(number), "a/manifest.db")
        return DONE

    work(queue, run, told=told)
    assert [name for name, _ in told] == ["a", "b"]
    assert type(told[0][1].error) is error
    [left] = queue.listing().jobs
    assert (left.name, left.desired, note in left.note) == ("a", desired, True)


def test_a_fault_of_the_programs_own_is_told_before_it_ends_the_runner(queue):
    queue.put(new_entry("a", text="x"))
    told: list[tuple[str, Ended]] = []

    def run(_job: QueuedJob, _control: FarmControl) -> JobOutcome:
        raise ZeroDivisionError("a fault")

    with pytest.raises(ZeroDivisionError):
        work(queue, run, told=told)
    [(name, ended)] = told
    assert (name, str(ended.error)) == ("a", "a fault")


def test_a_job_that_was_taken_over_by_another_process_is_waited_for(queue):
    queue.put(new_entry("a", text="x", priority=1))
    queue.put(new_entry("b", text="x"))
    turns: list[str] = []

    def run(job: QueuedJob, _control: FarmControl) -> JobOutcome:
        turns.append(job.name)
        if turns == ["a"]:
            raise LeaseLostError("a was taken over")
        return DONE

    work(queue, run)
    assert sorted(turns) == ["a", "a", "b"]
    assert queue.listing().jobs == ()


def test_a_job_that_goes_while_a_more_urgent_one_runs_was_not_ended_by_its_own_turn(queue):
    own = new_entry("own", text="x")
    queue.put(own)

    def run(job: QueuedJob, control: FarmControl) -> JobOutcome:
        if job.name == "own":
            queue.put(new_entry("urgent", text="x", priority=5))
            return until_stopped(control)
        queue.drop("own")
        return DONE

    assert work(queue, run, submission=own.submission) is None


def test_a_queue_that_vanishes_with_its_disk_cancels_nothing(queue):
    queue.put(new_entry("a", text="x"))

    def run(_job: QueuedJob, control: FarmControl) -> JobOutcome:
        aside = queue.folder.with_name("aside")
        queue.folder.rename(aside)
        ended = until_stopped(control)
        aside.rename(queue.folder)
        return ended

    told: list[tuple[str, Ended]] = []
    work(queue, run, told=told)
    assert told[0][1].reason is None


def test_the_disk_that_is_looked_at_is_the_one_that_the_job_is_written_to(queue, tmp_path, monkeypatch):
    (tmp_path / "other disk").mkdir()
    (tmp_path / "a").symlink_to(tmp_path / "other disk")
    asked: list[Path] = []
    monkeypatch.setattr("pipeline.queue.farm.disk.shortage", lambda folder, _reserve: asked.append(folder.resolve()))
    for name in "ab":
        queue.put(new_entry(name, text="x"))
    work(queue, lambda _job, _control: DONE)
    assert asked == [tmp_path / "other disk", tmp_path]


def test_what_could_not_be_taken_over_is_taken_over_at_the_next_event(queue, monkeypatch):
    job = new_entry("a", text="x")
    queue.put(job)
    observer = TakeOver(queue, job)
    observer.notify(RunStarted(()))
    with monkeypatch.context() as full:

        def refuse(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        full.setattr("pipeline.queue.job_queue.replace_durably", refuse)
        observer.notify(RunEnded(Outcome(DONE)))
    assert (entry := queue.find("a")) is not None
    assert entry.text == "x"
    observer.notify(RunEnded(Outcome(DONE)))
    assert (entry := queue.find("a")) is not None
    assert entry.text is None


@pytest.mark.parametrize(
    ("kind", "reason", "code"),
    [
        (JobOutcome.SUCCEEDED, None, 0),
        (JobOutcome.SUCCEEDED, StopReason.DISK_SHORT, 0),
        (JobOutcome.FAILED, StopReason.PAUSED, 5),
        (JobOutcome.DRAINED, StopReason.PAUSED, 8),
        (JobOutcome.CANCELLED, StopReason.CANCELLED, 8),
        (JobOutcome.DRAINED, StopReason.DISK_SHORT, 7),
        (None, StopReason.DISK_SHORT, 7),
        (JobOutcome.DRAINED, None, 130),
    ],
)
def test_exit_codes_say_how_it_ended_and_not_what_was_asked(kind, reason, code):
    assert exit_code_of(Ended(None if kind is None else Outcome(kind), reason)) == code


def test_resumed_a_job_keeps_the_cores_and_the_reserve_that_it_was_given(queue, monkeypatch):
    paused = new_entry("synthetic", text=job_text(), desired=Desired.PAUSE, cores=1, reserve_bytes=0)
    resumed: list[QueuedJob] = []
    monkeypatch.setattr(
        "pipeline.queue.turns.stand_in_queue", lambda _queue, _layout, entry, **_: resumed.append(entry) or 0
    )
    layout = queue.layout("synthetic")
    for options in (QueueOptions(), QueueOptions(cores=2)):
        job = job_of_text(job_text(), layout.job_file)
        assert run_command(job, layout, frozenset({"any"}), options=options, paused=paused) == 0
    assert [(entry.cores, entry.reserve_bytes) for entry in resumed] == [(1, 0), (2, 0)]


def test_what_another_host_queues_while_the_runner_gives_its_lease_back_is_run(queue, monkeypatch):
    elsewhere = JobQueue(queue.farm)
    turns: list[str] = []
    release = Lease.release

    def run(_turns: Turns, job: QueuedJob, _control: FarmControl, _observer: TakeOver) -> Outcome:
        turns.append(job.name)
        return Outcome(DONE)

    def release_late(lease: Lease) -> None:
        if turns == ["a"] and not elsewhere.find("b"):
            elsewhere.enqueue(new_entry("b", text="x", background=True))
            assert start_in_background(elsewhere) is None  # it sees a runner that lives
        release(lease)

    monkeypatch.setattr("fcntl.flock", lambda *_: None)  # locks end at each host
    monkeypatch.setattr(Turns, "run", run)
    monkeypatch.setattr(Lease, "release", release_late)
    queue.put(new_entry("a", text="x"))
    told = pipeline("work", "--farm", queue.farm)
    assert (told.exit_code, turns) == (0, ["a", "b"])
    assert "the queue is empty" in told.stderr


@pytest.mark.slow
def test_a_runner_in_the_background_takes_no_module_from_the_working_folder(queue, tmp_path, monkeypatch):
    queue.make()
    (tmp_path / "click.py").write_text("open('run', 'w').close()\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    pid = start_in_background(queue)
    assert pid is not None
    with suppress(ChildProcessError):  # it was over before it was looked at
        os.waitpid(pid, 0)
    assert "the queue is empty" in queue.log.read_text()
    assert not (tmp_path / "run").exists()
    shutil.rmtree(queue.folder)
