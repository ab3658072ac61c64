import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import pytest
from blake3 import blake3
from places import HELPERS
from record_samples import commit, film, validate_text

from pipeline.base.errors import InvalidArtifactError, StaleAttemptError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, task_fingerprint
from pipeline.store.artifacts import Commit, committing, sweep_parts
from pipeline.store.receipts import is_committed, read_receipt, verify_artifact

SIMULATE = film(1)[0]
ARTIFACT = SIMULATE.outputs[0]
FINGERPRINT = task_fingerprint(SIMULATE, {})
CHANGED = film(1, viscosity=2.0)[0]


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    layout = JobLayout(tmp_path / "job")
    layout.root.mkdir()
    return layout


def commit_of(layout: JobLayout, *, attempt: int) -> AbstractContextManager[Commit]:
    return committing(layout, ARTIFACT, task=SIMULATE, attempt=attempt, fingerprint=FINGERPRINT, validate=validate_text)


def files_below(folder: Path) -> set[str]:
    """Locks, and the texts that receipts name, left out."""
    names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file() and path.name != ".lock"}
    return {name for name in names if not name.startswith(".provenance/")}


def test_a_committed_artifact_lies_with_its_receipt_and_nothing_else(layout: JobLayout) -> None:
    receipt = commit(layout, SIMULATE, ARTIFACT, "first", attempt=3)
    assert files_below(layout.root) == {"cache/000000.h5", ".receipts/cache/000000.h5.json"}
    assert layout.path(ARTIFACT).read_text() == "first END"
    assert read_receipt(layout, ARTIFACT) == receipt
    assert (receipt.task, receipt.attempt, receipt.fingerprint) == (SIMULATE.id, 3, FINGERPRINT)
    assert (receipt.size, receipt.hash) == (9, blake3(b"first END").hexdigest())
    assert verify_artifact(layout, receipt, deep=True) is None
    assert is_committed(layout, ARTIFACT, FINGERPRINT)
    assert not is_committed(layout, ARTIFACT, task_fingerprint(CHANGED, {}))


def test_a_file_that_does_not_decode_is_not_committed(layout: JobLayout) -> None:
    with (
        pytest.raises(InvalidArtifactError, match="truncated"),
        commit_of(layout, attempt=1) as handle,
    ):
        handle.path.write_text("half of i")
    assert files_below(layout.root) == set()


def test_a_block_that_writes_nothing_is_an_error(layout: JobLayout) -> None:
    with (
        pytest.raises(InvalidArtifactError, match="nothing was written"),
        commit_of(layout, attempt=1),
    ):
        pass


def test_a_full_disk_keeps_its_errno_and_leaves_the_old_artifact_alone(layout: JobLayout) -> None:
    old = commit(layout, SIMULATE, ARTIFACT, "old")
    with (
        pytest.raises(OSError, match="No space left") as caught,
        commit_of(layout, attempt=2) as handle,
    ):
        handle.path.symlink_to("/dev/full")  # the kernel's own full disk
        with handle.path.open("wb", buffering=0) as file:
            file.write(b"new END")
    assert caught.value.errno == errno.ENOSPC
    assert files_below(layout.root) == {"cache/000000.h5", ".receipts/cache/000000.h5.json"}
    assert verify_artifact(layout, old, deep=True) is None


def test_a_late_writer_of_an_older_attempt_is_fenced_off(layout: JobLayout) -> None:
    with (
        pytest.raises(StaleAttemptError, match="attempt 2 of simulate has committed it; attempt 1 came too late"),
        commit_of(layout, attempt=1) as late,
    ):
        late.path.write_text("late END")
        commit(layout, SIMULATE, ARTIFACT, "newer", attempt=2)
    assert layout.path(ARTIFACT).read_text() == "newer END"
    assert files_below(layout.root) == {"cache/000000.h5", ".receipts/cache/000000.h5.json"}


def test_a_file_edited_by_hand_is_kept_aside(layout: JobLayout) -> None:
    commit(layout, SIMULATE, ARTIFACT, "ours", attempt=1)
    for attempt, name in ((2, "cache/000000.h5.edited-1"), (3, "cache/000000.h5.edited-2")):
        layout.path(ARTIFACT).write_text(f"theirs {attempt}")
        with commit_of(layout, attempt=attempt) as handle:
            handle.path.write_text("ours again END")
        assert handle.kept_aside == name
        assert (layout.root / name).read_text() == f"theirs {attempt}"
        assert layout.path(ARTIFACT).read_text() == "ours again END"


def test_an_untouched_or_merely_copied_file_is_not_kept_aside(layout: JobLayout) -> None:
    commit(layout, SIMULATE, ARTIFACT, "ours", attempt=1)
    os.utime(layout.path(ARTIFACT), ns=(1, 1))
    commit(layout, SIMULATE, ARTIFACT, "ours again", attempt=2)
    commit(layout, SIMULATE, ARTIFACT, "and again", attempt=3)
    assert files_below(layout.root) == {"cache/000000.h5", ".receipts/cache/000000.h5.json"}


def test_sweep_removes_part_files_and_nothing_else(layout: JobLayout) -> None:
    commit(layout, SIMULATE, ARTIFACT, "ours")
    kept = files_below(layout.root) | {"cache/.hidden", "cache/a.part.1", "cache/.a.part.x"}
    for name in ("cache/.hidden", "cache/a.part.1", "cache/.a.part.x"):
        (layout.root / name).touch()
    parts = [layout.root / "cache/.000001.h5.part.12", layout.root / ".receipts/cache/.000001.h5.json.part.12"]
    for part in parts:
        part.touch()
    assert sweep_parts(layout) == sorted(parts)
    assert files_below(layout.root) == kept


FILE_OPERATIONS = frozenset({"open", "os.mkdir", "os.remove", "os.rename"})
"""What Python reports of a commit before it is done; between two of these nothing on disk changes but file contents."""


def run_and_die_before_operation(work: Callable[[], object], number: int) -> bool:
    """Run `work` in a child that ends at once, without cleaning up, before its `number`-th operation on files.

    Returns whether the child got through before that.
    """
    child = os.fork()
    if child == 0:
        remaining = number

        def count_down(event: str, arguments: tuple[object, ...]) -> None:
            nonlocal remaining
            remaining -= event in FILE_OPERATIONS
            if remaining == 0:
                os._exit(9)

        try:
            sys.addaudithook(count_down)
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("edited", [False, True], ids=["replacing", "replacing an edited file"])
def test_no_crash_point_leaves_a_receipt_that_matches_a_wrong_file(tmp_path: Path, edited: bool) -> None:
    """Kill a commit before each operation in turn; whatever stands then, a receipt that verifies tells the truth."""
    seen: set[str] = set()
    number = 0
    through = False
    while not through:
        number += 1
        layout = JobLayout(tmp_path / str(number))
        old = commit(layout, SIMULATE, ARTIFACT, "old", attempt=1)
        if edited:
            layout.path(ARTIFACT).write_text("edited")
        through = run_and_die_before_operation(
            partial(commit, layout, CHANGED, ARTIFACT, "new content", attempt=2), number
        )
        content = layout.path(ARTIFACT).read_text() if layout.path(ARTIFACT).exists() else None
        receipt = read_receipt(layout, ARTIFACT)
        if receipt is None or verify_artifact(layout, receipt, deep=True) is not None:
            seen.add("nothing counts")
        elif receipt == old:
            assert content == "old END"
            seen.add("old")
        else:
            assert content == "new content END"
            assert receipt.fingerprint == task_fingerprint(CHANGED, {})
            seen.add("new")
        if edited:  # at every moment the user's text is somewhere
            assert "edited" in {path.read_text() for path in layout.path(ARTIFACT).parent.glob("000000.h5*")}
    assert seen == ({"nothing counts", "new"} if edited else {"old", "nothing counts", "new"})
    assert number > 12  # it did see the commit's operations


CRASHING_WRITER = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from record_samples import commit, film
from pipeline.base.layout import JobLayout

task = film(1)[0]
print("ready", flush=True)
for attempt in range(1, 100_000):
    commit(JobLayout(Path(sys.argv[1])), task, task.outputs[0], f"content {attempt} " * 500, attempt=attempt)
    print(attempt, flush=True)
"""


def test_kill_in_the_midst_of_commits_leaves_what_was_reported_or_something_newer(layout: JobLayout) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", CRASHING_WRITER, str(layout.root), str(HELPERS)],
        stdout=subprocess.PIPE,
        text=True,
    ) as writer:
        assert writer.stdout is not None
        reported = 0
        while reported < 20:
            line = writer.stdout.readline().strip()
            assert line, "it ended"
            reported = int(line) if line.isdigit() else 0
        writer.send_signal(signal.SIGKILL)
        reported = max([reported, *(int(line) for line in writer.stdout.read().split())])
    receipt = read_receipt(layout, ARTIFACT)
    if receipt is not None:
        assert receipt.attempt >= reported
        assert verify_artifact(layout, receipt, deep=True) is None
    recovered = commit(layout, SIMULATE, ArtifactPath(ARTIFACT), "after", attempt=reported + 2)
    assert verify_artifact(layout, recovered, deep=True) is None


def test_two_processes_that_commit_the_same_artifact_end_with_the_newer_attempt(layout: JobLayout) -> None:
    """Racing writers: attempt 2 always wins, whichever comes last."""
    for _ in range(10):
        children = []
        for attempt in (1, 2):
            child = os.fork()
            if child == 0:
                try:
                    commit(layout, SIMULATE, ARTIFACT, f"by {attempt}", attempt=attempt)
                except StaleAttemptError:
                    os._exit(3)
                finally:
                    os._exit(0)
            children.append(child)
        codes = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
        assert codes[1] == 0
        receipt = read_receipt(layout, ARTIFACT)
        assert receipt is not None
        assert receipt.attempt == 2
        assert layout.path(ARTIFACT).read_text() == "by 2 END"
        layout.receipt(ARTIFACT).unlink()
