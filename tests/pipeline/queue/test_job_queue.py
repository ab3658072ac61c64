"""The queue: order, commands, damaged files, and processes that are killed in the middle of changing it."""

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

import pytest
from command_line import pipeline
from places import PROJECT

from pipeline.base.errors import PipelineError
from pipeline.base.lease import Lease
from pipeline.queue.job_queue import Desired, JobQueue, QueuedJob, QueueError, checked_name, new_entry, new_submission


@pytest.fixture
def queue(tmp_path) -> JobQueue:
    return JobQueue(tmp_path)


def names(queue: JobQueue) -> list[str]:
    return [job.name for job in queue.listing().jobs]


def test_a_farm_where_nothing_was_submitted_has_an_empty_queue_and_nothing_is_made_for_looking(queue):
    assert queue.listing().jobs == queue.waiting() == ()
    assert queue.find("film") is None
    assert not queue.folder.exists()


def test_jobs_go_by_priority_and_then_by_age(queue):
    for position, (name, priority) in enumerate([("a", 0), ("b", 5), ("c", 0), ("d", -1), ("e", 5)]):
        queue.put(replace(new_entry(name, priority=priority), submitted=100.0 + position))
    assert names(queue) == ["b", "e", "a", "c", "d"]


def test_the_order_does_not_depend_on_clocks_of_machines(queue, monkeypatch):
    now = time.time()
    for name, error_s in (("c", 600.0), ("b", -600.0), ("a", 0.0)):
        with monkeypatch.context() as patch:
            patch.setattr("time.time", lambda error_s=error_s: now + error_s)
            queue.enqueue(new_entry(name))
        time.sleep(0.05)  # file systems count in steps
    assert names(queue) == ["c", "b", "a"]


def test_an_entry_comes_back_as_it_was_written(queue):
    job = new_entry(
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
        desired=Desired.PAUSE,
    )
    queue.put(job)
    assert queue.find("my film") == job


def test_submitted_again_a_waiting_job_keeps_its_place_and_the_same_run_its_ticket(queue):
    first = queue.enqueue(new_entry("a", text="1"))
    time.sleep(0.01)
    queue.enqueue(new_entry("b", text="1"))
    same = queue.enqueue(new_entry("a", text="1"))
    assert (same.submission, same.submitted) == (first.submission, first.submitted)
    other = queue.enqueue(new_entry("a", text="2"))
    assert other.submission != first.submission
    assert names(queue) == ["a", "b"]


def test_the_text_that_a_run_has_taken_over_asks_for_no_second_run(queue):
    first = queue.enqueue(new_entry("a", text="1"))
    layout = queue.layout("a")
    layout.root.mkdir()
    layout.job_file.write_text("1")
    queue.change("a", text=None)
    assert queue.enqueue(new_entry("a", text="1")).submission == first.submission
    assert queue.enqueue(new_entry("a", text="2")).submission != first.submission


def test_a_failed_job_submitted_again_runs_again(queue):
    first = queue.enqueue(new_entry("a", text="1"))
    queue.change("a", desired=Desired.NONE, note="failed")
    again = queue.enqueue(new_entry("a", text="1"))
    assert (again.desired, again.note, again.submission != first.submission) == (Desired.RUN, "", True)


def test_run_again_while_a_new_version_waits_it_is_that_version_that_runs(queue):
    queue.enqueue(new_entry("a", text="new version"))
    again = queue.enqueue(new_entry("a", rerun_stages=("render",)))
    assert (again.text, again.rerun_stages) == ("new version", ("render",))
    assert queue.find("a") == again


def test_entries_that_nobody_changes_are_read_once(queue, monkeypatch):
    for name in "ab":
        queue.put(new_entry(name))
        os.utime(queue.folder / "queue" / f"{name}.json", (1.0, 1.0))
    before = queue.listing()
    read: list[str] = []
    from_json = QueuedJob.from_json
    monkeypatch.setattr(QueuedJob, "from_json", lambda text: read.append(text) or from_json(text))
    assert queue.listing() == before
    assert read == []
    JobQueue(queue.farm).change("a", priority=3)
    read.clear()
    assert [job.priority for job in queue.listing().jobs] == [3, 0]
    assert len(read) == 1


def test_a_change_counts_that_another_host_made_though_attributes_are_those_of_before(queue, monkeypatch):
    monkeypatch.setattr("pipeline.queue.job_queue._version", lambda _status: (0, 0, 0))
    old = queue.enqueue(new_entry("a"))
    os.utime(queue.folder / "queue" / "a.json", (1.0, 1.0))
    assert queue.find("a") == old
    JobQueue(queue.farm).change("a", desired=Desired.PAUSE)
    assert queue.find("a") == old
    with queue.locked():
        assert queue.find("a") == replace(old, desired=Desired.PAUSE)


def test_what_killed_writers_left_is_swept_and_entries_stay(queue):
    queue.put(new_entry("a"))
    left = queue.folder / "queue" / ".a.json.part.77"
    left.write_text("half")
    queue.sweep()
    assert left.exists()  # on another machine somebody may be writing it
    os.utime(left, (0, 0))
    queue.sweep()
    assert (left.exists(), names(queue)) == (False, ["a"])


@pytest.mark.parametrize(
    ("number", "sentence"),
    [(errno.ENOLCK, "has no locks"), (errno.EOPNOTSUPP, "has no locks"), (errno.ENOSYS, "has no locks")],
)
def test_a_file_system_without_locks_is_told(queue, monkeypatch, number, sentence):
    def flock(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises(QueueError, match=sentence):
        queue.put(new_entry("a"))
    with pytest.raises(PipelineError, match=sentence):
        Lease.acquire(queue.lease)


def test_a_farm_that_cannot_be_written_to_is_told(queue, monkeypatch):
    def make(_queue: JobQueue) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(JobQueue, "make", make)
    with pytest.raises(QueueError, match="the queue lies there"):
        queue.put(new_entry("a"))


@pytest.mark.parametrize("command", ["pause", "cancel"])
def test_a_folder_that_is_none_is_not_made_by_a_command_about_a_job(tmp_path, command):
    told = pipeline(command, "film", "--farm", tmp_path / "typo")
    assert (told.exit_code, '"film" is not in the queue' in told.stderr) == (1, True)
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_record_of_one_job_hides_no_other_from_the_list(queue):
    queue.put(new_entry("good"))
    queue.put(new_entry("bad"))
    queue.layout("bad").root.mkdir()
    queue.layout("bad").manifest.write_bytes(b"garbage" * 2000)
    told = pipeline("status", "--farm", queue.farm, "--json")
    listed = json.loads(told.stdout)
    assert [job["name"] for job in listed["jobs"]] == ["good", "bad"]
    assert len(listed["flaws"]) == 1
    assert "bad" in listed["flaws"][0]


@pytest.mark.parametrize(
    "name", ["", ".", "..", ".farm", "a/b", "../a", "a\0b", "x" * 201, "a\nb", "a\x1b[2J", "caf\udce9"]
)
def test_a_name_cannot_lead_out_of_the_farm(queue, name):
    with pytest.raises(QueueError, match="cannot be the name"):
        checked_name(name)
    with pytest.raises(QueueError):
        queue.put(QueuedJob(name=name, submission=new_submission()))
    with pytest.raises(QueueError):
        queue.layout(name)


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
        new_entry("b").to_json().encode(),
        new_entry("a").to_json().replace('"run"', '"jump"').encode(),
        new_entry("a").to_json().replace('"priority": 0', '"priority": "0"').encode(),
        new_entry("a").to_json().replace('"background": false', '"background": 1').encode(),
        new_entry("a").to_json().replace('"rerun_stages": null', '"rerun_stages": [[1]]').encode(),
        new_entry("a").to_json().replace('"settings": []', '"settings": [1]').encode(),
        json.dumps(json.loads(new_entry("a").to_json()) | {"submitted": float("inf")}).encode(),
        json.dumps(json.loads(new_entry("a").to_json()) | {"submitted": float("nan")}).encode(),
        json.dumps(json.loads(new_entry("a").to_json()) | {"submitted": 10**400}).encode(),
        new_entry("a").to_json().replace('"cores": null', '"cores": null, "code": "x"').encode(),
    ],
)
def test_a_file_that_is_no_entry_is_told_and_the_others_go_on(queue, content):
    queue.put(new_entry("good"))
    (queue.folder / "queue" / "a.json").write_bytes(content)
    listing = queue.listing()
    assert [job.name for job in listing.jobs] == ["good"]
    assert len(listing.flaws) == 1
    assert "a.json: not an entry" in listing.flaws[0]
    assert "remove it, and submit the job again" in listing.flaws[0]
    queue.enqueue(new_entry("a"))  # which the remedy is
    assert queue.listing().flaws == ()


CHANGER = """
import sys
from pathlib import Path
from pipeline.queue.job_queue import JobQueue, Desired, new_entry

queue = JobQueue(Path(sys.argv[1]))
number = 0
print("ready", flush=True)
while True:
    number += 1
    queue.enqueue(new_entry("mine", text="x" * 20_000, priority=number % 7))
    queue.change("mine", desired=Desired.PAUSE, note=str(number))
    queue.put(new_entry("other"))
    queue.drop("other")
"""


def test_threads_that_overlap_exclude_each_other_and_leave_the_lock_whole(queue):
    is_in, order = threading.Event(), []

    def second() -> None:
        is_in.set()
        with queue.locked():
            order.append("second")

    overlapping = threading.Thread(target=second)
    with queue.locked():
        overlapping.start()
        is_in.wait()
        overlapping.join(timeout=0.2)  # as long as it would need many times over, were it let in
        order.append("first")
    overlapping.join()
    assert order == ["first", "second"]
    with queue.locked():
        other = os.open(queue.folder / "lock", os.O_RDWR)
        with pytest.raises(BlockingIOError):  # another description of the file stands for another process
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.close(other)


@pytest.mark.slow
def test_killed_in_the_middle_of_a_change_it_leaves_no_lock_and_loses_no_job(queue):
    generator = random.Random(6)
    queue.put(new_entry("bystander"))
    queue.put(new_entry("mine"))
    for _ in range(12):
        changer = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(CHANGER), str(queue.farm)],
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(PROJECT)},
        )
        assert changer.stdout is not None
        changer.stdout.readline()
        time.sleep(generator.uniform(0.0, 0.1))
        os.kill(changer.pid, signal.SIGKILL)
        changer.communicate()
        began = time.monotonic()
        queue.change("mine", note="ours")  # raises if the entry were lost or damaged, and hangs at a stale lock
        assert time.monotonic() - began < 30.0
        listing = queue.listing()
        assert listing.flaws == ()
        assert {"bystander", "mine"} <= {job.name for job in listing.jobs} <= {"bystander", "mine", "other"}
