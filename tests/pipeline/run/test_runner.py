"""Whole runs over the synthetic stages: what runs, what does not run again, and how faults end."""

import errno
import os
import sqlite3
from dataclasses import replace
from pathlib import Path

import pytest
from synthetic_jobs import Recorder, contents, job_text, run_recorded, run_synthetic
from synthetic_stages import FilmStage, write_faults

from pipeline.base.errors import PlanError
from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, Resources, TaskId, TaskState
from pipeline.record.manifest import Manifest
from pipeline.run.control import Selection
from pipeline.run.events import Committed, Failed, JobOutcome, Notice, RunEnded, RunStarted
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.executors.processes import ProcessExecutor

ALL = ["steps", *(f"double/{k:06d}" for k in range(6)), "film"]


@pytest.fixture
def root(tmp_path) -> Path:
    return tmp_path / "job"


@pytest.fixture
def finished(root) -> Path:
    run_recorded(root)
    return root


def test_a_new_job_runs_every_task_once(root):
    outcome, recorder = run_recorded(root)
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


def test_a_finished_job_has_nothing_to_do(finished):
    before = contents(finished)
    outcome, recorder = run_recorded(finished)
    assert (outcome.kind, outcome.ran) == (JobOutcome.SUCCEEDED, 0)
    assert recorder.ran() == []
    assert contents(finished) == before


def test_a_run_with_nothing_to_do_removes_the_temporary_folders_of_killed_workers(finished, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    left = tmp_path / "pipeline-tmp-worker-of_a_killed_run"
    left.mkdir()
    (left / "half.png").write_bytes(b"half")
    run_recorded(finished)
    assert not left.exists()


def test_a_later_stage_starts_while_the_simulation_runs(root):
    write_faults(root, {"steps": ["wait for reader@5"]})
    recorder = Recorder()
    with ProcessExecutor() as executor:
        assert run_synthetic(root, executor, observers=[recorder.notify]).kind is JobOutcome.SUCCEEDED
    order = [event.receipt.artifact for event in recorder.of(Committed)]
    assert order.index("double/000000.bin") < order.index("steps/000005.bin")


def test_a_changed_camera_reruns_only_what_reads_it(finished):
    _, recorder = run_recorded(finished, job_text(focal_length_mm=35.0))
    assert recorder.ran() == [name for name in ALL if name != "steps"]


def test_a_longer_film_continues_the_simulation(finished):
    _, recorder = run_recorded(finished, job_text(frames=8))
    assert recorder.ran() == ["steps", "double/000006", "double/000007", "film"]
    assert [e.receipt.artifact for e in recorder.of(Committed) if e.task_id == "steps"] == [
        "steps/000006.bin",
        "steps/000007.bin",
    ]


def test_what_turns_out_the_same_stops_the_rebuild_there(finished):
    """Early cutoff: a lost file is made anew with the same bytes, so nobody who read it runs."""
    (finished / "steps/000002.bin").unlink()
    outcome, recorder = run_recorded(finished)
    assert recorder.ran() == ["steps"]
    assert outcome.counts["double", TaskState.UP_TO_DATE] == 6


def test_a_truncated_artifact_is_made_anew(finished):
    whole = contents(finished)
    os.truncate(finished / "double/000003.bin", 10)
    _, recorder = run_recorded(finished)
    assert recorder.ran() == ["double/000003"]
    assert contents(finished) == whole


@pytest.mark.parametrize("rerun", [None, Selection(frozenset({"double"}))])
def test_an_edited_artifact_is_kept_aside_and_that_is_said(finished, rerun):
    (finished / "double/000003.bin").write_bytes(b"painted over by hand")
    _, recorder = run_recorded(finished, rerun=rerun)
    assert (finished / "double/000003.bin.edited-1").read_bytes() == b"painted over by hand"
    assert any("double/000003.bin.edited-1" in notice.message for notice in recorder.of(Notice))


def test_selected_frames_run_again(finished):
    _, recorder = run_recorded(finished, rerun=Selection(frozenset({"double"}), frozenset({1, 2})))
    assert recorder.ran() == ["double/000001", "double/000002"]


def test_a_selected_simulation_runs_again_from_the_start(finished):
    _, recorder = run_recorded(finished, rerun=Selection(frozenset({"steps"})))
    assert recorder.ran() == ["steps"]
    assert len([e for e in recorder.of(Committed) if e.task_id == "steps"]) == 6


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
def test_a_selection_of_what_is_not_there_is_refused(finished, selection, complaint):
    with pytest.raises(PlanError) as refused:
        run_recorded(finished, rerun=selection)
    assert str(refused.value) == complaint
    with Manifest.open_readonly(JobLayout(finished).manifest) as manifest:
        assert manifest.last_run().outcome == JobOutcome.SUCCEEDED


def test_a_failed_frame_is_told_and_runs_next_time(root):
    write_faults(root, {"double/000002": ["fail"]})
    outcome, _ = run_recorded(root)
    assert (outcome.kind, outcome.exit_code) == (JobOutcome.FAILED, 5)
    assert [(f.task_id, f.kind) for f in outcome.failures] == [("double/000002", FailureKind.FAILED)]
    assert outcome.counts["film", TaskState.UPSTREAM_FAILED] == 1
    outcome, recorder = run_recorded(root)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert recorder.ran() == ["double/000002", "film"]


def test_a_diverged_simulation_is_told_as_such(root):
    write_faults(root, {"steps": ["diverge@3"]})
    outcome, recorder = run_recorded(root)
    assert outcome.failures[0].kind is FailureKind.DIVERGED
    assert recorder.ran() == ["double/000000", "double/000001", "double/000002"]


def test_a_lost_worker_is_retried_within_the_run(root):
    write_faults(root, {"steps": ["kill@3"], "double/000001": ["segfault"]})
    recorder = Recorder()
    with ProcessExecutor() as executor:
        outcome = run_synthetic(root, executor, observers=[recorder.notify])
    assert (outcome.kind, outcome.failures) == (JobOutcome.SUCCEEDED, ())
    assert sorted(event.task_id for event in recorder.of(Failed)) == ["double/000001", "steps"]
    assert len([e for e in recorder.of(Committed) if e.task_id == "steps"]) == 6  # each frame once, over two attempts
    assert list(root.rglob(".*.part.*")) == []


def test_a_full_disk_pauses_the_job_and_the_next_run_finishes_it(root):
    write_faults(root, {"double/000002": ["disk full"]})
    outcome, recorder = run_recorded(root)
    assert (outcome.kind, outcome.failures) == (JobOutcome.DISK_FULL, ())
    assert any("disk is full" in notice.message for notice in recorder.of(Notice))
    outcome, recorder = run_recorded(root)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert "double/000001" not in recorder.ran()


def test_the_disk_that_is_full_is_named_also_where_it_is_not_the_one_of_the_job(root):
    write_faults(root, {"double/000002": ["temporary disk full"]})
    outcome, recorder = run_recorded(root)
    assert (outcome.kind, outcome.full_place) == (JobOutcome.DISK_FULL, "/temporary/file")
    (told,) = (notice.message for notice in recorder.of(Notice) if "disk is full" in notice.message)
    assert told.startswith("the disk is full (/temporary/file): the job pauses")


def test_a_manifest_on_a_full_disk_loses_nothing(root, monkeypatch):
    record_artifact = Manifest.record_artifact

    def full_at_the_third_frame(self: Manifest, receipt: object) -> None:
        if "000002" in receipt.artifact:  # type: ignore[attr-defined]
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        record_artifact(self, receipt)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(Manifest, "record_artifact", full_at_the_third_frame)
        assert run_recorded(root)[0].kind is JobOutcome.DISK_FULL
    outcome, recorder = run_recorded(root)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert "steps" not in recorder.ran()  # its receipts told the record what it had missed


def test_a_lost_manifest_is_made_anew_of_the_receipts(finished):
    JobLayout(finished).manifest.unlink()
    _, recorder = run_recorded(finished)
    assert recorder.ran() == []


def test_the_manifest_is_whole_after_a_run(finished):
    with sqlite3.connect(JobLayout(finished).manifest) as connection:
        assert connection.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert connection.execute("PRAGMA foreign_key_check").fetchall() == []


def test_the_record_says_how_each_run_ended(root):
    write_faults(root, {"double/000002": ["fail"]})
    run_recorded(root)
    with Manifest.open_readonly(JobLayout(root).manifest) as manifest:
        failed = manifest.last_run()
    run_recorded(root)
    with Manifest.open_readonly(JobLayout(root).manifest) as manifest:
        succeeded = manifest.last_run()
    assert (failed.outcome, succeeded.outcome) == (JobOutcome.FAILED, JobOutcome.SUCCEEDED)
    assert failed.run != succeeded.run


def test_without_a_gpu_that_works_the_job_pauses_and_continues(tmp_path, monkeypatch):
    """The film's first two GPUs fail; the third draws it in the next run."""
    plan = FilmStage.plan
    on_gpu = Resources(gpus=1)
    monkeypatch.setattr(FilmStage, "plan", lambda *args: [replace(task, resources=on_gpu) for task in plan(*args)])
    root, recorder = tmp_path / "job", Recorder()
    write_faults(root, {"film": ["lose GPU", "lose GPU and abort"]})
    outcomes = []
    for _ in range(2):
        with ProcessExecutor(gpus=2) as executor:
            options = {"observers": [recorder.notify], "capacity": Resources(cores=2, gpus=2)}
            outcomes.append(run_synthetic(root, executor, **options).kind)
    assert outcomes == [JobOutcome.NO_GPU, JobOutcome.SUCCEEDED]
    assert [notice.message.partition(";")[0] for notice in recorder.of(Notice)] == [
        f"GPU {gpu} failed in film and gets no task any more in this run" for gpu in (1, 0)
    ]


def test_what_no_machine_has_is_a_clear_line(tmp_path, monkeypatch):
    plan = FilmStage.plan
    on_gpu = Resources(gpus=1)
    monkeypatch.setattr(FilmStage, "plan", lambda *args: [replace(task, resources=on_gpu) for task in plan(*args)])
    with InlineExecutor() as executor, pytest.raises(PlanError, match="film needs 1 GPUs"):
        run_synthetic(tmp_path / "job", executor)
