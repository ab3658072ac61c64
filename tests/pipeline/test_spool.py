"""The spool: order, commands, damaged files, and processes that are killed in the middle of changing it."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import random
import signal
import subprocess
import sys
import textwrap
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import pipeline

from pipeline.commands.arguments import find_job
from pipeline.commands.queueing import place
from pipeline.errors import PipelineError
from pipeline.lease import Lease
from pipeline.spool import QueuedJob, Spool, SpoolError, Wish, checked_name, new_ticket, submission


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path)


def names(spool: Spool) -> list[str]:
    return [job.name for job in spool.listing().jobs]


def test_a_farm_where_nothing_was_submitted_has_an_empty_queue_and_nothing_is_made_for_looking(spool: Spool) -> None:
    assert spool.listing().jobs == spool.waiting() == ()
    assert spool.find("film") is None
    assert not spool.folder.exists()


def test_jobs_go_by_priority_and_then_by_age(spool: Spool) -> None:
    for position, (name, priority) in enumerate([("a", 0), ("b", 5), ("c", 0), ("d", -1), ("e", 5)]):
        spool.put(replace(submission(name, priority=priority), submitted=100.0 + position))
    assert names(spool) == ["b", "e", "a", "c", "d"]


def test_an_entry_comes_back_as_it_was_written(spool: Spool) -> None:
    job = submission(
        "my film",
        priority=3,
        text='name = "my film"\n',
        rerun_stages=("render",),
        rerun_frames=(1, 2),
        cores=2,
        reserve_bytes=10,
        background=True,
        settings=(("executor", "dask"),),
        note="why",
        wish=Wish.PAUSE,
    )
    spool.put(job)
    assert spool.find("my film") == job


def test_submitted_again_a_waiting_job_keeps_its_place_and_the_same_run_its_ticket(spool: Spool) -> None:
    first = spool.enqueue(submission("a", text="1"))
    time.sleep(0.01)
    spool.enqueue(submission("b", text="1"))
    same = spool.enqueue(submission("a", text="1"))
    assert (same.ticket, same.submitted) == (first.ticket, first.submitted)
    other = spool.enqueue(submission("a", text="2"))
    assert other.ticket != first.ticket
    assert names(spool) == ["a", "b"]


def test_the_text_that_a_run_has_taken_over_asks_for_no_second_run(spool: Spool) -> None:
    first = spool.enqueue(submission("a", text="1"))
    layout = spool.layout("a")
    layout.root.mkdir()
    layout.job_file.write_text("1")
    spool.change("a", text=None)
    assert spool.enqueue(submission("a", text="1")).ticket == first.ticket
    assert spool.enqueue(submission("a", text="2")).ticket != first.ticket


def test_a_failed_job_submitted_again_runs_again(spool: Spool) -> None:
    first = spool.enqueue(submission("a", text="1"))
    spool.change("a", wish=Wish.NONE, note="failed")
    again = spool.enqueue(submission("a", text="1"))
    assert (again.wish, again.note, again.ticket != first.ticket) == (Wish.RUN, "", True)


def test_run_again_while_a_new_version_waits_it_is_that_version_that_runs(spool: Spool) -> None:
    spool.enqueue(submission("a", text="new version"))
    again = spool.enqueue(submission("a", rerun_stages=("render",)))
    assert (again.text, again.rerun_stages) == ("new version", ("render",))
    assert spool.find("a") == again


def test_entries_that_nobody_changes_are_read_once(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in "ab":
        spool.put(submission(name))
        os.utime(spool.folder / "queue" / f"{name}.json", (1.0, 1.0))
    before = spool.listing()
    read: list[str] = []
    from_json = QueuedJob.from_json
    monkeypatch.setattr(QueuedJob, "from_json", lambda text: read.append(text) or from_json(text))
    assert spool.listing() == before
    assert read == []
    Spool(spool.farm).change("a", priority=3)
    read.clear()
    assert [job.priority for job in spool.listing().jobs] == [3, 0]
    assert len(read) == 1


def test_what_killed_writers_left_is_swept_and_entries_stay(spool: Spool) -> None:
    spool.put(submission("a"))
    left = spool.folder / "queue" / ".a.json.part.77"
    left.write_text("half")
    spool.sweep()
    assert (left.exists(), names(spool)) == (False, ["a"])


@pytest.mark.parametrize(
    ("number", "sentence"),
    [(errno.ENOLCK, "has no locks"), (errno.EOPNOTSUPP, "has no locks"), (errno.ENOSYS, "has no locks")],
)
def test_a_file_system_without_locks_is_told(
    spool: Spool, monkeypatch: pytest.MonkeyPatch, number: int, sentence: str
) -> None:
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(SpoolError, match=sentence):
        spool.put(submission("a"))
    with pytest.raises(PipelineError, match=sentence):
        Lease.acquire(spool.lease)


def test_a_farm_that_cannot_be_written_to_is_told(spool: Spool, monkeypatch: pytest.MonkeyPatch) -> None:
    def make(_spool: Spool) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Spool, "make", make)
    with pytest.raises(SpoolError, match="the queue lies there"):
        spool.put(submission("a"))


@pytest.mark.parametrize("command", ["pause", "cancel"])
def test_a_folder_that_is_none_is_not_made_by_a_command_about_a_job(tmp_path: Path, command: str) -> None:
    told = pipeline(command, "film", "--output", tmp_path / "typo")
    assert (told.exit_code, '"film" is not in the queue' in told.stderr) == (1, True)
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_record_of_one_job_hides_no_other_from_the_list(spool: Spool) -> None:
    spool.put(submission("good"))
    spool.put(submission("bad"))
    spool.layout("bad").root.mkdir()
    spool.layout("bad").manifest.write_bytes(b"garbage" * 2000)
    told = pipeline("queue", "--output", spool.farm, "--json")
    listed = json.loads(told.stdout)
    assert [job["name"] for job in listed["jobs"]] == ["good", "bad"]
    assert len(listed["flaws"]) == 1
    assert "bad" in listed["flaws"][0]


def test_commands_about_the_queue_and_about_files_mean_the_same_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("dam", "renders/dam"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "job.toml").touch()
    spool, name = place("dam", Path("renders"))
    assert spool.layout(name).root == find_job("dam", Path("renders")).root.absolute() == tmp_path / "dam"
    (tmp_path / "dam" / "renders").mkdir()
    monkeypatch.chdir(tmp_path / "dam")
    assert place(".", Path("renders"))[1] == "dam"


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".farm", "a/b", "../a", "a\0b", "x" * 201, "a\nb", "a\x1b[2J", "caf\udce9"]
)
def test_a_name_cannot_lead_out_of_the_farm(spool: Spool, name: str) -> None:
    with pytest.raises(SpoolError, match="cannot be the name"):
        checked_name(name)
    with pytest.raises(SpoolError):
        spool.put(QueuedJob(name=name, ticket=new_ticket()))
    with pytest.raises(SpoolError):
        spool.layout(name)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{",
        b"[]",
        b"null",
        b"\xff\xfe",
        b"[" * 100_000,
        json.dumps({"name": "a"}).encode(),
        submission("b").to_json().encode(),
        submission("a").to_json().replace('"run"', '"jump"').encode(),
        submission("a").to_json().replace('"priority": 0', '"priority": "0"').encode(),
        submission("a").to_json().replace('"background": false', '"background": 1').encode(),
        submission("a").to_json().replace('"rerun_stages": null', '"rerun_stages": [[1]]').encode(),
        submission("a").to_json().replace('"settings": []', '"settings": [1]').encode(),
        json.dumps(json.loads(submission("a").to_json()) | {"submitted": float("inf")}).encode(),
        json.dumps(json.loads(submission("a").to_json()) | {"submitted": float("nan")}).encode(),
        json.dumps(json.loads(submission("a").to_json()) | {"submitted": 10**400}).encode(),
        submission("a").to_json().replace('"cores": null', '"cores": null, "code": "x"').encode(),
    ],
)
def test_a_file_that_is_no_entry_is_told_and_the_others_go_on(spool: Spool, content: bytes) -> None:
    spool.put(submission("good"))
    (spool.folder / "queue" / "a.json").write_bytes(content)
    listing = spool.listing()
    assert [job.name for job in listing.jobs] == ["good"]
    assert len(listing.flaws) == 1
    assert "a.json: not an entry" in listing.flaws[0]
    assert "remove it, and submit the job again" in listing.flaws[0]
    spool.enqueue(submission("a"))  # which the remedy is
    assert spool.listing().flaws == ()


CHANGER = """
import sys
from pathlib import Path
from pipeline.spool import Spool, Wish, submission

spool = Spool(Path(sys.argv[1]))
number = 0
print("ready", flush=True)
while True:
    number += 1
    spool.enqueue(submission("mine", text="x" * 20_000, priority=number % 7))
    spool.change("mine", wish=Wish.PAUSE, note=str(number))
    spool.put(submission("other"))
    spool.drop("other")
"""


def test_threads_that_overlap_exclude_each_other_and_leave_the_lock_whole(spool: Spool) -> None:
    is_in, order = threading.Event(), []

    def second() -> None:
        is_in.set()
        with spool.locked():
            order.append("second")

    overlapping = threading.Thread(target=second)
    with spool.locked():
        overlapping.start()
        is_in.wait()
        overlapping.join(timeout=0.2)  # as long as it would need many times over, were it let in
        order.append("first")
    overlapping.join()
    assert order == ["first", "second"]
    with spool.locked():
        other = os.open(spool.folder / "lock", os.O_RDWR)
        with pytest.raises(BlockingIOError):  # another description of the file stands for another process
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(other)


@pytest.mark.slow
def test_killed_in_the_middle_of_a_change_it_leaves_no_lock_and_loses_no_job(spool: Spool) -> None:
    generator = random.Random(6)
    spool.put(submission("bystander"))
    spool.put(submission("mine"))
    for _ in range(12):
        changer = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(CHANGER), str(spool.farm)],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        )
        assert changer.stdout is not None
        changer.stdout.readline()
        time.sleep(generator.uniform(0.0, 0.1))
        os.kill(changer.pid, signal.SIGKILL)
        changer.communicate()
        began = time.monotonic()
        spool.change("mine", note="ours")  # raises if the entry were lost or damaged, and hangs at a stale lock
        assert time.monotonic() - began < 30.0
        listing = spool.listing()
        assert listing.flaws == ()
        assert {"bystander", "mine"} <= {job.name for job in listing.jobs} <= {"bystander", "mine", "other"}
