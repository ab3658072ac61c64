import dataclasses
import errno
import platform
import re
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from places import HELPERS
from record_samples import film, make_film

from pipeline.base.errors import LeaseLostError, ManifestError, OutdatedManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, TaskId, TaskState
from pipeline.record.manifest import Manifest, artifact_row, is_on_network, move_out_of_reach
from pipeline.record.migrations import migrations, schema_version
from pipeline.record.reader import SUCCEEDED, LastRun, ManifestReader, StageSummary
from pipeline.store.receipts import Receipt

SIMULATE = TaskId("simulate")
RENDER = TaskId("render/000000")


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    return JobLayout(tmp_path)


def receipt(**changes: object) -> Receipt:
    task = film(1)[1]
    plain = Receipt(
        artifact=task.outputs[0],
        task=task.id,
        stage=task.stage,
        attempt=1,
        fingerprint="f",
        parameters=task.parameters.digest,
        size=3,
        mtime_ns=5,
        hash="h",
        inputs={task.inputs[0]: "i"},
    )
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


def test_a_new_manifest_has_the_newest_schema_and_safe_settings(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        connection = manifest._connection
        assert schema_version(connection) == len(migrations())
        assert connection.execute("PRAGMA foreign_keys").fetchone() == (1,)
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert connection.execute("PRAGMA synchronous").fetchone() == (2,)
    assert {path.name for path in layout.root.iterdir()} == {"manifest.db"}  # closing leaves no log behind


def test_the_plan_is_counted_per_stage_in_its_order(layout: JobLayout) -> None:
    tasks = film(3)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(tasks, {SIMULATE: TaskState.UP_TO_DATE})
        manifest.set_states({RENDER: TaskState.RUNNING})
        assert manifest.summary() == [
            StageSummary("simulate", {TaskState.UP_TO_DATE: 1}),
            StageSummary("render", {TaskState.RUNNING: 1, TaskState.PENDING: 2}),
            StageSummary("movie", {TaskState.PENDING: 1}),
        ]
        assert [stage.total for stage in manifest.summary()] == [1, 3, 1]
        assert list(manifest.states()) == [task.id for task in tasks]


def test_a_task_that_leaves_the_plan_keeps_its_history_and_counts_no_more(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(3))
        last = TaskId("render/000002")
        assert manifest.start_attempt(last) == 1
        manifest.record_plan(film(2))
        assert last not in manifest.states()
        assert sum(stage.total for stage in manifest.summary()) == 4
        assert len(manifest.history(last)) == 1
        manifest.record_plan(film(3))
        assert manifest.start_attempt(last) == 2


def test_attempt_numbers_grow_for_ever_and_survive_a_new_plan_and_a_reopening(layout: JobLayout) -> None:
    for expected in (1, 2, 3):
        with Manifest(layout.manifest) as manifest:
            manifest.record_plan(film(1, viscosity=expected))
            assert manifest.start_attempt(SIMULATE) == expected
            assert manifest.states()[SIMULATE] is TaskState.RUNNING


def test_an_attempt_tells_its_story(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        first = manifest.start_attempt(RENDER)
        assert [attempt.task for attempt in manifest.running_attempts()] == [RENDER]
        manifest.finish_attempt(
            RENDER, first, failure=FailureKind.STALLED, message="no progress", state=TaskState.FAILED
        )
        assert [attempt.outcome for attempt in manifest.failures()] == [FailureKind.STALLED]
        second = manifest.start_attempt(RENDER)
        manifest.finish_attempt(RENDER, second, seconds=1.5, peak_memory_bytes=7, state=TaskState.SUCCEEDED)
        stalled, succeeded = manifest.history(RENDER)
        assert (stalled.number, stalled.outcome, stalled.message) == (1, "stalled", "no progress")
        assert (stalled.log, stalled.host) == ("logs/render/000000.1.log", platform.node())
        assert succeeded.log == "logs/render/000000.2.log"
        assert (succeeded.outcome, succeeded.seconds, succeeded.peak_memory_bytes) == (SUCCEEDED, 1.5, 7)
        assert manifest.running_attempts() == []
        assert manifest.failures() == []


def test_a_closed_attempt_keeps_what_it_says(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        number = manifest.start_attempt(RENDER)
        manifest.finish_attempt(RENDER, number, failure=FailureKind.CANCELLED)
        manifest.finish_attempt(RENDER, number)
        assert manifest.history(RENDER)[0].outcome == FailureKind.CANCELLED


def test_an_artifact_row_is_replaced_by_a_newer_one(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        manifest.record_artifact(receipt())
        newer = receipt(attempt=2, hash="other", size=9)
        manifest.record_artifact(newer)
        assert manifest.artifacts() == {newer.artifact: artifact_row(newer)}
        manifest.adopt_mtimes({newer.artifact: 77})
        assert manifest.artifacts()[newer.artifact].mtime_ns == 77
        manifest.forget_artifacts([newer.artifact])
        assert manifest.artifacts() == {}


def test_a_receipt_of_an_unknown_attempt_keeps_its_number_used(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_artifact(receipt(attempt=5))
        manifest.record_plan(film(1))
        assert manifest.start_attempt(RENDER) == 6


def test_parameters_are_found_by_their_digest_after_the_plan_has_changed(layout: JobLayout) -> None:
    old = film(1)[0].parameters
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        manifest.record_plan(film(1, viscosity=3.0))
        assert manifest.parameters(old.digest) == old
        assert manifest.parameters("unknown") is None


def test_events_come_back_in_order_of_all_or_of_one_task(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.log_event("takeover", "one")
        manifest.log_event("edited", "two", task=RENDER)
        manifest.log_event("paused", "three")
        assert [event.message for event in manifest.events()] == ["one", "two", "three"]
        assert [event.message for event in manifest.events(limit=2)] == ["two", "three"]
        assert [event.kind for event in manifest.events(task=RENDER)] == ["edited"]


def test_a_transaction_is_kept_whole_or_not_at_all(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        with pytest.raises(KeyError), manifest.transaction():
            manifest.start_attempt(RENDER)
            manifest.record_artifact(receipt())
            raise KeyError
        assert manifest.history(RENDER) == []
        assert manifest.artifacts() == {}
        assert manifest.states()[RENDER] is TaskState.PENDING


def test_a_run_is_clean_only_if_the_last_one_ended_and_how_is_known_only_then(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        assert manifest.last_run() == LastRun(None, None)
        assert not manifest.begin_run("film", run="first")
        manifest.end_run("failed")
        assert manifest.last_run() == LastRun("first", "failed")
        assert manifest.begin_run("film", run="second")
        assert manifest.last_run() == LastRun("second", None)
        assert not manifest.begin_run("film")
        manifest.end_run("cancelled", clean=False)
        assert not manifest.begin_run("film")


def test_a_run_that_was_taken_over_writes_nothing_any_more(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as slept, Manifest(layout.manifest) as newer:
        slept.record_plan(film(1))
        slept.begin_run("film", run="first")
        slept.log_event("pause", "it sleeps")
        newer.begin_run("film", run="second")
        with pytest.raises(LeaseLostError, match="was taken over"):
            slept.start_attempt(RENDER)
        assert newer.history(RENDER) == []
        newer.start_attempt(RENDER)


def test_a_record_that_another_process_has_locked_is_told(layout: JobLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.record.manifest.BUSY_TIMEOUT_S", 0.0)
    with Manifest(layout.manifest) as manifest, manifest.transaction():
        manifest.log_event("pause", "it is written")
        with (
            Manifest(layout.manifest) as other,
            pytest.raises(ManifestError, match=r"another process, .* has locked it"),
        ):
            other.log_event("pause", "it waits")


KILLED_WRITER = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from record_samples import film
from pipeline.record.manifest import Manifest
from pipeline.base.task import TaskId, TaskState

manifest = Manifest(Path(sys.argv[1]))
manifest.record_plan(film(2))
manifest.start_attempt(TaskId("simulate"))
manifest.set_states({TaskId("film"): TaskState.CANCELLED})
manifest._connection.execute("BEGIN IMMEDIATE")
manifest._connection.execute("DELETE FROM task WHERE id = 'film'")
os._exit(9)
"""


def test_a_killed_writer_loses_only_the_transaction_it_was_in(layout: JobLayout) -> None:
    ended = subprocess.run([sys.executable, "-c", KILLED_WRITER, str(layout.manifest), str(HELPERS)], check=False)
    assert ended.returncode == 9
    with Manifest(layout.manifest) as manifest:
        assert manifest.states()[TaskId("film")] is TaskState.CANCELLED
        assert [attempt.task for attempt in manifest.running_attempts()] == [SIMULATE]


def test_readers_see_each_commit_while_the_writer_goes_on_and_cannot_write(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as writer, Manifest.open_readonly(layout.manifest) as reader:
        writer.record_plan(film(1))
        assert reader.states()[RENDER] is TaskState.PENDING
        with writer.transaction():
            writer.set_states({RENDER: TaskState.SUCCEEDED})
            assert reader.states()[RENDER] is TaskState.PENDING
        assert reader.states()[RENDER] is TaskState.SUCCEEDED
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            reader._connection.execute("DELETE FROM task")


def test_reading_before_the_first_submit_is_a_clear_error(layout: JobLayout) -> None:
    with pytest.raises(ManifestError, match="has not been submitted yet"):
        Manifest.open_readonly(layout.manifest)


@pytest.mark.parametrize("offset", [0, 3 * 4096])
def test_a_damaged_manifest_names_its_remedy(layout: JobLayout, offset: int) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(300))
    content = bytearray(layout.manifest.read_bytes())
    content[offset : offset + 3000] = b"\xa5" * 3000
    layout.manifest.write_bytes(content)
    with pytest.raises(ManifestError, match=rf"damaged .* pipeline verify {re.escape(str(layout.root))} --rebuild"):
        Manifest(layout.manifest)


def damage_pages_past_the_header(manifest: Path) -> None:
    content = bytearray(manifest.read_bytes())
    content[4096:] = b"\xa5" * (len(content) - 4096)
    manifest.write_bytes(content)


@pytest.mark.parametrize(
    "query",
    [
        ManifestReader.artifacts,
        ManifestReader.states,
        ManifestReader.summary,
        ManifestReader.running_attempts,
        ManifestReader.failures,
        ManifestReader.events,
        ManifestReader.last_run,
        ManifestReader.stage_costs,
        lambda manifest: manifest.history(RENDER),
        lambda manifest: manifest.parameters("any"),
    ],
)
def test_damage_past_the_header_is_named_by_every_query(
    layout: JobLayout, query: Callable[[ManifestReader], object]
) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(30))
    damage_pages_past_the_header(layout.manifest)
    with (
        Manifest.open_readonly(layout.manifest) as reader,
        pytest.raises(ManifestError, match=r"is damaged .* --rebuild"),
    ):
        query(reader)


def test_damage_that_shows_at_writing_is_named_too(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(30))
    with Manifest(layout.manifest) as manifest:
        manifest._connection.execute("PRAGMA shrink_memory")  # forget the pages that were read at opening
        damage_pages_past_the_header(layout.manifest)
        with pytest.raises(ManifestError, match="is damaged"):
            manifest.set_states({RENDER: TaskState.RUNNING})


def test_a_manifest_that_is_only_busy_is_not_called_damaged(layout: JobLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "pipeline.record.manifest.is_on_network", lambda _: True
    )  # a rollback journal, which locks readers out
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        manifest._connection.execute("BEGIN EXCLUSIVE")
        with pytest.raises(ManifestError, match=r"manifest\.db cannot be read \(another process, .* has locked it\)"):
            Manifest.open_readonly(layout.manifest, timeout_s=0.0)


def test_a_folder_that_is_not_there_is_not_called_damage(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match=r"cannot be opened .* folder must exist and be writable"):
        Manifest(tmp_path / "nowhere" / "manifest.db")


def test_a_manifest_of_a_newer_program_is_refused(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest._connection.execute("PRAGMA user_version = 99")
    for opening in (Manifest, Manifest.open_readonly):
        with pytest.raises(ManifestError, match=r"schema version 99, and this program knows \d+"):
            opening(layout.manifest)


def test_a_full_disk_is_told_as_such_and_loses_nothing(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        pages = manifest._connection.execute("PRAGMA page_count").fetchone()[0]
        manifest._connection.execute(f"PRAGMA max_page_count = {pages}")  # SQLite's own way to run out of space
        with pytest.raises(OSError, match="No space left") as caught:
            manifest.record_plan(film(2000))
        assert caught.value.errno == errno.ENOSPC
        assert len(manifest.states()) == 3


def test_costs_are_means_over_what_a_stage_has_made(layout: JobLayout) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(2))
        for frame, seconds in ((0, 2.0), (1, 4.0)):
            task = TaskId(f"render/{frame:06d}")
            number = manifest.start_attempt(task)
            manifest.record_artifact(receipt(task=task, artifact=f"frames/{frame:06d}.png", size=100 * (frame + 1)))
            manifest.finish_attempt(task, number, seconds=seconds)
        cost = manifest.stage_costs()
        assert cost.keys() == {"render"}
        assert (cost["render"].seconds_per_artifact, cost["render"].bytes_per_artifact) == (3.0, 150.0)


def test_a_whole_film_goes_through_the_record_unchanged(layout: JobLayout) -> None:
    tasks = film(3)
    receipts = make_film(layout, tasks)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(tasks)
        manifest.record_artifacts(receipts)
    with Manifest.open_readonly(layout.manifest) as reader:
        assert reader.artifacts() == {one.artifact: artifact_row(one) for one in receipts}


def test_a_network_file_system_gets_a_rollback_journal(monkeypatch: pytest.MonkeyPatch, layout: JobLayout) -> None:
    monkeypatch.setattr("pipeline.record.manifest.is_on_network", lambda _: True)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        manifest.set_states({RENDER: TaskState.FAILED})
        assert manifest._connection.execute("PRAGMA journal_mode").fetchone() == ("truncate",)
        assert manifest._connection.execute("PRAGMA synchronous").fetchone() == (2,)


def test_who_was_cut_off_in_the_middle_of_a_commit_reaches_the_record_no_more(
    monkeypatch: pytest.MonkeyPatch, layout: JobLayout
) -> None:
    monkeypatch.setattr("pipeline.record.manifest.is_on_network", lambda _: True)
    with Manifest(layout.manifest) as cut_off:
        cut_off.record_plan(film(1))
        cut_off.begin_run("film", run="first")
        with cut_off.transaction():
            cut_off.start_attempt(RENDER)
            move_out_of_reach(layout.manifest)
            with Manifest(layout.manifest) as newer:
                newer.begin_run("film", run="second")
        with pytest.raises(LeaseLostError, match="was taken over"):
            cut_off.log_event("pause", "it goes on")
    with Manifest.open_readonly(layout.manifest) as reader:
        assert (reader.last_run().run, reader.history(RENDER)) == ("second", [])
    assert not [*layout.root.rglob("*.part.*")]


def test_a_commit_that_was_cut_off_for_good_is_undone_by_the_next_run(
    monkeypatch: pytest.MonkeyPatch, layout: JobLayout, tmp_path: Path
) -> None:
    monkeypatch.setattr("pipeline.record.manifest.is_on_network", lambda _: True)
    left = tmp_path / "left"
    left.mkdir()
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(film(1))
        manifest._connection.execute("PRAGMA cache_size = 1")  # pages are written before the commit
        with manifest.transaction():
            manifest.record_plan(film(500))
            for file in layout.root.glob("manifest.db*"):
                shutil.copy(file, left)
    with pytest.raises(OutdatedManifestError, match="in the middle of a change"):
        Manifest.open_readonly(left / "manifest.db")
    move_out_of_reach(left / "manifest.db")
    with Manifest.open_readonly(left / "manifest.db") as reader:
        assert len(reader.states()) == len(film(1))


def test_network_file_systems_are_told_by_the_deepest_mount(tmp_path: Path) -> None:
    mounts = [("/", "ext4"), (str(tmp_path), "nfs4"), (str(tmp_path / "scratch"), "xfs"), ("/elsewhere", "cifs")]
    assert is_on_network(tmp_path / "job" / "manifest.db", mounts)
    assert not is_on_network(tmp_path / "scratch" / "manifest.db", mounts)
    assert is_on_network(tmp_path / "remote" / "x", [*mounts, (str(tmp_path / "remote"), "fuse.sshfs")])
    assert not is_on_network(tmp_path.parent / "x", mounts)
