"""A farm's runner among troubles: busy folders, disks that refuse, jobs that change or go while another one runs."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from synthetic_jobs import job_text

from pipeline.commands.running import QueueOptions
from pipeline.commands.running import run as run_command
from pipeline.commands.turns import exit_code_of
from pipeline.errors import DiskFullError, JobBusyError, LeaseLostError, PipelineError
from pipeline.farm import Ended, FarmControl, FarmRunner, StopReason, TakeOver, start_in_background
from pipeline.job.loading import job_of_text
from pipeline.lease import Lease
from pipeline.run_events import Outcome, RunEnded, RunStarted
from pipeline.scheduler_events import JobOutcome
from pipeline.spool import QueuedJob, Spool, Wish, submission

Run = Callable[[QueuedJob, FarmControl], JobOutcome]
DONE = JobOutcome.SUCCEEDED
MANY_LOOKS = 100_000


@pytest.fixture
def spool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Spool:
    monkeypatch.setattr("pipeline.farm.LOOK_INTERVAL_S", 0.001)
    monkeypatch.setattr("pipeline.farm.BUSY_RETRY_S", 0.01)
    return Spool(tmp_path)


def work(
    spool: Spool, run: Run, *, ticket: str | None = None, told: list[tuple[str, Ended]] | None = None
) -> Ended | None:
    def run_job(job: QueuedJob, control: FarmControl, _observer: TakeOver) -> Outcome:
        return Outcome(run(job, control))

    spool.make()
    with Lease.acquire(spool.lease) as lease:
        runner = FarmRunner(spool, lease, run_job, print, ticket=ticket)
        runner.after_turn = lambda name, _folder, ended: (told if told is not None else []).append((name, ended))
        return runner.work()


def until_stopped(control: FarmControl) -> JobOutcome:
    """Work on until the farm stops it, or has looked often enough."""
    for _ in range(MANY_LOOKS):
        if control.interruptions:
            return JobOutcome.DRAINED
    return DONE


def test_an_urgent_job_whose_folder_was_busy_goes_first_as_soon_as_it_is_free(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.farm.BUSY_RETRY_S", 3600.0)
    spool.put(submission("low", text="x"))
    spool.put(submission("urgent", text="x", priority=9))
    folder = spool.layout("urgent").root
    folder.mkdir()
    cleaning = Lease.acquire(spool.layout("urgent").lease)
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

    work(spool, run)
    assert turns == ["urgent", "low", "urgent", "low"]


@pytest.mark.parametrize(
    ("number", "wish", "error", "note"),
    [
        (errno.EIO, Wish.NONE, PipelineError, os.strerror(errno.EIO)),
        (errno.ENOSPC, Wish.PAUSE, DiskFullError, "the disk is full"),
    ],
)
def test_a_folder_that_refuses_ends_the_turn_of_its_job_alone(
    spool: Spool, number: int, wish: Wish, error: type[PipelineError], note: str
) -> None:
    spool.put(submission("a", text="x", priority=1))
    spool.put(submission("b", text="x"))
    told: list[tuple[str, Ended]] = []

    def run(job: QueuedJob, _control: FarmControl) -> JobOutcome:
        if job.name == "a":
            raise OSError(number, os.strerror(number), "a/manifest.db")
        return DONE

    work(spool, run, told=told)
    assert [name for name, _ in told] == ["a", "b"]
    assert type(told[0][1].error) is error
    [left] = spool.listing().jobs
    assert (left.name, left.wish, note in left.note) == ("a", wish, True)


def test_a_fault_of_the_programs_own_is_told_before_it_ends_the_runner(spool: Spool) -> None:
    spool.put(submission("a", text="x"))
    told: list[tuple[str, Ended]] = []

    def run(_job: QueuedJob, _control: FarmControl) -> JobOutcome:
        raise ZeroDivisionError("a fault")

    with pytest.raises(ZeroDivisionError):
        work(spool, run, told=told)
    [(name, ended)] = told
    assert (name, str(ended.error)) == ("a", "a fault")


def test_a_job_that_was_taken_over_by_another_process_is_waited_for(spool: Spool) -> None:
    spool.put(submission("a", text="x", priority=1))
    spool.put(submission("b", text="x"))
    turns: list[str] = []

    def run(job: QueuedJob, _control: FarmControl) -> JobOutcome:
        turns.append(job.name)
        if turns == ["a"]:
            raise LeaseLostError("a was taken over")
        return DONE

    work(spool, run)
    assert sorted(turns) == ["a", "a", "b"]
    assert spool.listing().jobs == ()


def test_a_job_that_goes_while_a_more_urgent_one_runs_was_not_ended_by_its_own_turn(spool: Spool) -> None:
    own = submission("own", text="x")
    spool.put(own)

    def run(job: QueuedJob, control: FarmControl) -> JobOutcome:
        if job.name == "own":
            spool.put(submission("urgent", text="x", priority=5))
            return until_stopped(control)
        spool.drop("own")
        return DONE

    assert work(spool, run, ticket=own.ticket) is None


def test_a_queue_that_vanishes_with_its_disk_cancels_nothing(spool: Spool) -> None:
    spool.put(submission("a", text="x"))

    def run(_job: QueuedJob, control: FarmControl) -> JobOutcome:
        aside = spool.folder.with_name("aside")
        spool.folder.rename(aside)
        ended = until_stopped(control)
        aside.rename(spool.folder)
        return ended

    told: list[tuple[str, Ended]] = []
    work(spool, run, told=told)
    assert told[0][1].reason is None


def test_the_disk_that_is_looked_at_is_the_one_that_the_job_is_written_to(
    spool: Spool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other disk").mkdir()
    (tmp_path / "a").symlink_to(tmp_path / "other disk")
    asked: list[Path] = []
    monkeypatch.setattr("pipeline.farm.disk.shortage", lambda folder, _reserve: asked.append(folder.resolve()))
    for name in "ab":
        spool.put(submission(name, text="x"))
    work(spool, lambda _job, _control: DONE)
    assert asked == [tmp_path / "other disk", tmp_path]


def test_what_could_not_be_taken_over_is_taken_over_at_the_next_event(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = submission("a", text="x")
    spool.put(job)
    observer = TakeOver(spool, job)
    observer.notify(RunStarted(()))
    with monkeypatch.context() as full:

        def refuse(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        full.setattr("pipeline.spool.replace_durably", refuse)
        observer.notify(RunEnded(Outcome(DONE)))
    assert (entry := spool.find("a")) is not None
    assert entry.text == "x"
    observer.notify(RunEnded(Outcome(DONE)))
    assert (entry := spool.find("a")) is not None
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
def test_exit_codes_say_how_it_ended_and_not_what_was_asked(
    kind: JobOutcome | None, reason: StopReason | None, code: int
) -> None:
    assert exit_code_of(Ended(None if kind is None else Outcome(kind), reason)) == code


def test_resumed_a_job_keeps_the_cores_and_the_reserve_that_it_was_given(
    spool: Spool, monkeypatch: pytest.MonkeyPatch
) -> None:
    paused = submission("synthetic", text=job_text(), wish=Wish.PAUSE, cores=1, reserve_bytes=0)
    resumed: list[QueuedJob] = []
    monkeypatch.setattr(
        "pipeline.commands.turns.stand_in_queue", lambda _spool, _layout, entry, **_: resumed.append(entry) or 0
    )
    layout = spool.layout("synthetic")
    for options in (QueueOptions(), QueueOptions(cores=2)):
        with pytest.raises(SystemExit):
            run_command(
                job_of_text(job_text(), layout.job_file), layout, frozenset({"any"}), options=options, paused=paused
            )
    assert [(entry.cores, entry.reserve_bytes) for entry in resumed] == [(1, 0), (2, 0)]


@pytest.mark.slow
def test_a_runner_in_the_background_takes_no_module_from_the_working_folder(
    spool: Spool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool.make()
    (tmp_path / "click.py").write_text("open('run', 'w').close()\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    pid = start_in_background(spool)
    assert pid is not None
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert "the queue is empty" in spool.log.read_text()
    assert not (tmp_path / "run").exists()
    shutil.rmtree(spool.folder)
