"""On which machines a job runs: what the options mean, and what is worth telling of the end."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import pytest
from synthetic_jobs import job_text

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, Resources, TaskId
from pipeline.job.loading import job_of_text
from pipeline.model.job import Job
from pipeline.queue import submitting, turns
from pipeline.queue.farm import Ended, StopReason
from pipeline.queue.job_queue import QueuedJob, new_entry
from pipeline.queue.notifications import notification_of
from pipeline.queue.submitting import QueueOptions
from pipeline.run.events import Failed, JobOutcome, Outcome
from pipeline.run.executors.choice import (
    ExecutorChoice,
    Machines,
    open_machines,
    require_named_devices,
    scheduler_address,
)
from pipeline.run.executors.dask_local import split

FOLDER = Path("/films/dam")


@pytest.mark.parametrize(
    ("options", "choice"),
    [
        ((None, None, None), ExecutorChoice()),
        (("dask", None, None), ExecutorChoice("dask")),
        ((None, "tcp://farm:8786", None), ExecutorChoice("dask", "tcp://farm:8786")),
        ((None, None, 2), ExecutorChoice("dask", None, 2)),
        (("inline", None, None), ExecutorChoice("inline")),
    ],
)
def test_the_queue_keeps_what_the_options_mean(options, choice):
    assert ExecutorChoice.of(*options) == choice
    assert ExecutorChoice.from_settings(choice.settings) == choice


def test_the_queue_keeps_where_the_scheduler_file_is_for_whoever_runs_it():
    assert ExecutorChoice.of(None, "farm.json", None).scheduler == str(Path.cwd() / "farm.json")


FARM = ExecutorChoice("dask", "tcp://farm:8786")
ALL = frozenset({"simulate", "render"})


def queued(job: Job, folder: Path, monkeypatch: pytest.MonkeyPatch, **arguments: Any) -> QueuedJob:
    """What `run` puts into the queue."""
    entries: list[QueuedJob] = []

    def keep(_spool: object, _layout: object, entry: QueuedJob, **_: object) -> int:
        entries.append(entry)
        return 0

    monkeypatch.setattr(turns, "stand_in_queue", keep)
    assert submitting.run(job, JobLayout(folder), frozenset({"surface"}), **arguments) == 0
    [entry] = entries
    return entry


def test_what_was_queued_for_a_cluster_goes_on_there_and_may_be_taken_back(tmp_path, monkeypatch):
    job, paused = job_of_text(job_text(), tmp_path / "job.toml"), new_entry("job", settings=FARM.settings)
    here = QueueOptions(executor="processes")
    assert queued(job, tmp_path / "job", monkeypatch, options=here, paused=paused).settings == ()

    def refuse(*_: object) -> None:
        raise AssertionError("a job of a cluster is held against this machine")

    monkeypatch.setattr(submitting, "require_possible", refuse)
    assert queued(job, tmp_path / "job", monkeypatch, options=QueueOptions(), paused=paused).settings == FARM.settings


def test_several_machines_get_no_device_to_choose_for_themselves(tmp_path):
    job = job_of_text(job_text(), tmp_path / "job.toml")
    farm = QueueOptions(scheduler="tcp://farm:8786")
    with pytest.raises(PipelineError, match=r"device and render.device = auto, but machines may differ"):
        submitting.run(job, JobLayout(tmp_path / "job"), ALL, options=farm)
    require_named_devices(job, {"surface", "movie"})
    set_here = job.model_copy(update={"device": "cpu"})
    with pytest.raises(PipelineError, match=r"^render.device = auto.*as with --set render.device=cpu \("):
        require_named_devices(set_here, ALL)


def test_cores_of_this_machine_are_nothing_to_a_cluster(tmp_path):
    job = job_of_text(job_text(), tmp_path / "job.toml")
    with pytest.raises(click.UsageError, match="--cores is for this machine"):
        submitting.run(
            job, JobLayout(tmp_path / "job"), ALL, options=QueueOptions(scheduler="tcp://farm:8786", cores=2)
        )


def test_options_that_do_not_go_together_are_refused():
    with pytest.raises(click.UsageError, match="with --scheduler, start workers there"):
        ExecutorChoice.of("dask", "tcp://farm:8786", 2)
    with pytest.raises(click.UsageError, match="are for --executor dask"):
        ExecutorChoice.of("processes", "tcp://farm:8786", None)
    with pytest.raises(PipelineError, match="there is none of"):
        ExecutorChoice.from_settings((("executor", "ray"),))


def test_a_scheduler_is_an_address_or_a_scheduler_file(tmp_path):
    assert scheduler_address("tls://farm:8786") == "tls://farm:8786"
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"address": "tcp://10.0.0.1:8786", "type": "Scheduler"}))
    assert scheduler_address(str(file)) == "tcp://10.0.0.1:8786"
    for text in ("{}", "[]", "not json"):
        file.write_text(text)
        with pytest.raises(PipelineError, match="not an address like"):
            scheduler_address(str(file))
    with pytest.raises(PipelineError, match="No such file"):
        scheduler_address("farm")


def test_cores_and_memory_are_shared_out_and_gpus_go_round():
    assert split(Resources(5, 1000, 1), 2) == [Resources(3, 500, 1), Resources(2, 500, 0)]
    assert split(Resources(2, 10, 0), 1) == [Resources(2, 10, 0)]
    with pytest.raises(ValueError, match="3 workers cannot share 2 cores"):
        split(Resources(2), 3)


def test_a_local_cluster_offers_what_it_is_given(tmp_path):
    told: list[str] = []
    here = Resources(2, 2_000_000_000, 1)
    with open_machines(ExecutorChoice("dask", None, 2), JobLayout(tmp_path / "job"), here, told.append) as machines:
        assert machines.machine is not None
        assert machines.machine.cores == 1
    with pytest.raises(PipelineError, match="use fewer --workers"):
        _open(ExecutorChoice("dask", None, 3), tmp_path, here)


def _open(choice: ExecutorChoice, tmp_path: Path, here: Resources) -> Machines:
    with open_machines(choice, JobLayout(tmp_path / "job"), here, print) as machines:
        return machines


def test_a_wrong_scheduler_is_a_line_and_not_a_traceback(tmp_path):
    (tmp_path / "small.toml").write_text(job_text())
    command = [sys.executable, "-m", "pipeline", "submit", "small.toml", "--scheduler", "farm"]
    command += ["--set", "device=cpu", "--set", "render.device=cpu"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].startswith(
        f"error: --scheduler {tmp_path / 'farm'}: not an address like tcp://farm:8786"
    )


# --- what is told of the end ---


def outcome(kind: JobOutcome, *failures: Failed) -> Outcome:
    return Outcome(kind, ran=1, failures=failures, seconds=2.0)


@pytest.mark.parametrize(
    ("ended", "event", "message"),
    [
        (Ended(outcome(JobOutcome.SUCCEEDED)), "done", "/films/dam/movie.mp4 is done"),
        (
            Ended(outcome(JobOutcome.FAILED, Failed(TaskId("render/000003"), 1, FailureKind.FAILED, "no camera"))),
            "failed",
            "render/000003: no camera",
        ),
        (Ended(outcome(JobOutcome.TOO_MANY_FAILURES)), "failed", "too many failures"),
        (Ended(None, error=PipelineError("the record is damaged")), "failed", "the record is damaged"),
        (
            Ended(outcome(JobOutcome.DISK_FULL)),
            "paused",
            "stopped (disk full); continue with: pipeline resume /films/dam",
        ),
        (Ended(outcome(JobOutcome.DRAINED)), "paused", "stopped; continue with: pipeline resume /films/dam"),
        (Ended(None, StopReason.DISK_SHORT), "paused", "disk short; continue with: pipeline resume /films/dam"),
        (
            Ended(outcome(JobOutcome.DRAINED), StopReason.PAUSED),
            "paused",
            "paused; continue with: pipeline resume /films/dam",
        ),
        (Ended(outcome(JobOutcome.SUCCEEDED), StopReason.PAUSED), "done", "/films/dam/movie.mp4 is done"),
    ],
)
def test_ends_are_told(ended, event, message):
    notification = notification_of("dam", FOLDER, ended)
    assert notification is not None
    assert (notification.event, notification.message) == (event, message)


@pytest.mark.parametrize("reason", [StopReason.YIELDED, StopReason.CANCELLED])
def test_a_turn_that_only_gives_way_and_one_that_was_cancelled_are_no_news(reason):
    assert notification_of("dam", FOLDER, Ended(outcome(JobOutcome.DRAINED), reason)) is None
