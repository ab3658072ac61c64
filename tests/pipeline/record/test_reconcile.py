import os
import shutil
from pathlib import Path

import pytest
from record_samples import commit, film, make_film

from pipeline.base.errors import ManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, FailureKind, TaskId, TaskState
from pipeline.record.manifest import Manifest
from pipeline.record.reconcile import (
    FileCondition,
    Reconciliation,
    inspect_files,
    rebuild_manifest,
    receipts,
    reconcile,
)
from pipeline.run.plan import Verdict, assess
from pipeline.store.receipts import read_receipt

FRAMES = 3
PICTURE = ArtifactPath("frames/000001.png")


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    """A job whose last run ended cleanly with everything made."""
    layout = JobLayout(tmp_path / "job")
    layout.root.mkdir()
    tasks = film(FRAMES)
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("film")
        manifest.record_plan(tasks)
        manifest.record_artifacts(make_film(layout, tasks))
        manifest.end_run()
    return layout


def run(layout: JobLayout) -> Reconciliation:
    """The start and the clean end of one run."""
    with Manifest(layout.manifest) as manifest:
        found = reconcile(manifest, layout, clean=manifest.begin_run("film"))
        manifest.end_run()
        return found


def stale_tasks(found: Reconciliation) -> list[str]:
    assessed = assess(film(FRAMES), found.rows, found.problems, parameters=lambda _: None)
    return [assessment.task.id for assessment in assessed if assessment.verdict is Verdict.STALE]


def test_a_clean_untouched_job_has_nothing_to_put_right(layout: JobLayout) -> None:
    found = run(layout)
    assert (found.problems, found.sentences) == ({}, ())
    assert len(found.rows) == 2 * FRAMES + 1
    assert found.valid_rows == found.rows
    assert stale_tasks(found) == []


def test_commits_that_the_record_did_not_learn_of_are_adopted_after_a_crash(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.forget_artifacts([PICTURE])
        manifest.begin_run("film")  # and never end_run
    found = run(layout)
    assert found.sentences == ("found 1 finished file that the record did not know yet",)
    assert stale_tasks(found) == []
    assert run(layout).sentences == ()


def test_attempts_that_died_with_their_runner_are_closed_as_worker_lost(layout: JobLayout) -> None:
    task = TaskId("render/000001")
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("film")
        manifest.start_attempt(task)
    (layout.root / "frames/.000001.png.part.2").write_text("half")
    found = run(layout)
    assert found.sentences == (
        "1 attempt ended with the last runner, first render/000001; each starts again",
        "swept away 1 unfinished file",
    )
    with Manifest.open_readonly(layout.manifest) as reader:
        assert reader.history(task)[-1].outcome == FailureKind.WORKER_LOST
        assert reader.states()[task] is TaskState.PENDING


def test_a_vanished_file_is_dropped_from_the_record_and_made_anew(layout: JobLayout) -> None:
    layout.path(PICTURE).unlink()
    found = run(layout)
    assert found.problems[PICTURE].condition is FileCondition.MISSING
    assert stale_tasks(found) == ["render/000001"]
    with Manifest.open_readonly(layout.manifest) as reader:
        assert PICTURE not in reader.artifacts()


def test_an_edited_file_is_announced_before_it_is_made_anew(layout: JobLayout) -> None:
    layout.path(PICTURE).write_text("painted over")
    found = run(layout)
    assert found.problems[PICTURE].condition is FileCondition.EDITED
    (sentence,) = found.sentences
    assert sentence.startswith("frames/000001.png: file was edited or truncated: size 12, receipt says ")
    assert sentence.endswith("before it is made anew it is kept as frames/000001.png.edited-1")
    with Manifest.open_readonly(layout.manifest) as reader:
        assert [event.message for event in reader.events(task=TaskId("render/000001"))] == [sentence]


def test_an_empty_file_is_found_and_not_worth_keeping(layout: JobLayout) -> None:
    os.truncate(layout.path(PICTURE), 0)
    (sentence,) = run(layout).sentences
    assert sentence.startswith("frames/000001.png: file was edited or truncated: size 0, receipt says ")
    assert "kept" not in sentence


def test_a_file_left_by_a_cut_commit_is_no_edit(layout: JobLayout) -> None:
    layout.receipt(PICTURE).unlink()
    layout.path(PICTURE).write_text("new content whose receipt was not written END")
    found = run(layout)
    assert found.problems[PICTURE].condition is FileCondition.INTERRUPTED
    assert found.sentences == ()
    assert stale_tasks(found) == ["render/000001"]


def test_a_copied_folder_is_as_good_as_the_original(layout: JobLayout, tmp_path: Path) -> None:
    copy = JobLayout(tmp_path / "elsewhere" / "copy")
    shutil.copytree(layout.root, copy.root, copy_function=shutil.copyfile)  # times are not kept
    found = run(copy)
    assert (found.problems, found.sentences) == ({}, ())
    assert stale_tasks(found) == []
    with Manifest.open_readonly(copy.manifest) as reader:
        rows = reader.artifacts()
    assert rows == found.rows
    assert rows[PICTURE].mtime_ns == copy.path(PICTURE).stat().st_mtime_ns
    assert inspect_files(copy, rows).new_mtimes_ns == {}


def test_a_newer_commit_is_adopted_even_after_a_clean_end(layout: JobLayout) -> None:
    tasks = film(FRAMES)
    source = tasks[2].inputs[0]
    receipt = read_receipt(layout, source)
    assert receipt is not None
    newer = commit(layout, tasks[2], PICTURE, "by a late worker", attempt=7, hashes={source: receipt.hash})
    found = run(layout)
    assert found.problems == {}
    assert (found.rows[PICTURE].attempt, found.rows[PICTURE].hash) == (7, newer.hash)
    assert stale_tasks(found) == ["film"]


def test_a_lost_manifest_comes_back_from_the_receipts(layout: JobLayout) -> None:
    with Manifest.open_readonly(layout.manifest) as reader:
        before = reader.artifacts()
    layout.manifest.write_bytes(b"not a database" * 100)
    with pytest.raises(ManifestError):
        Manifest(layout.manifest)
    kept, count = rebuild_manifest(layout)
    assert kept == layout.root / "manifest.db.damaged-1"
    assert count == len(before)
    with Manifest(layout.manifest) as manifest:
        assert manifest.artifacts() == before
        manifest.record_plan(film(FRAMES))
        assert manifest.start_attempt(TaskId("render/000001")) == 2
    assert stale_tasks(run(layout)) == []


def test_a_deleted_manifest_comes_back_by_itself(layout: JobLayout) -> None:
    layout.manifest.unlink()
    found = run(layout)
    assert found.sentences == ("found 7 finished files that the record did not know yet",)
    assert stale_tasks(found) == []


def test_a_rebuild_never_gives_an_attempt_number_twice_even_for_a_file_that_is_gone(layout: JobLayout) -> None:
    layout.path(PICTURE).unlink()
    layout.manifest.unlink()
    run(layout)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(FRAMES))
        assert manifest.start_attempt(TaskId("render/000001")) == 2


def test_receipts_are_read_from_where_they_belong_only(layout: JobLayout) -> None:
    expected = {receipt.artifact for receipt in receipts(layout)}
    shutil.copyfile(layout.receipt(PICTURE), layout.receipt(ArtifactPath("frames/000099.png")))
    (layout.receipts / "frames" / "broken.json").write_text("{")
    assert {receipt.artifact for receipt in receipts(layout)} == expected
    assert len(expected) == 2 * FRAMES + 1
