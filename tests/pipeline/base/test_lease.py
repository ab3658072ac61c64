import dataclasses
import errno
import fcntl
import json
import multiprocessing
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import pytest

from pipeline.base.errors import JobBusyError, LeaseLostError
from pipeline.base.lease import EXPIRY_S, Lease, LeaseHolder, live_holder, read_holder, remove_guard

ONE_DAY_S = 86_400.0


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runner.lease"


def write_holder(path: Path, *, age_s: float = 0.0, **changes: Any) -> LeaseHolder:
    """Leave a lease behind as another process would have."""
    holder = dataclasses.replace(LeaseHolder.this_process(), **changes)
    path.write_text(json.dumps(asdict(holder)))
    os.utime(path, (time.time() - age_s,) * 2)
    return holder


def ended_process() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
        return process.pid


def test_a_lease_names_its_holder_and_leaves_nothing_when_given_back(path: Path) -> None:
    with Lease.acquire(path) as lease:
        assert lease.takeover is None
        holder = read_holder(path)
        assert holder == lease.holder == live_holder(path)
        assert holder.pid == os.getpid()
    assert not path.exists()
    assert live_holder(path) is None


def test_a_live_holder_is_busy_and_named(path: Path) -> None:
    with Lease.acquire(path), pytest.raises(JobBusyError, match=rf"run already, by process {os.getpid()} on \S+ since"):
        Lease.acquire(path)


def test_a_live_but_silent_holder_of_this_machine_keeps_its_lease(path: Path) -> None:
    write_holder(path, age_s=ONE_DAY_S)
    with pytest.raises(JobBusyError):
        Lease.acquire(path)


def test_a_holder_that_is_gone_is_taken_over_aloud(path: Path) -> None:
    pid = ended_process()
    write_holder(path, pid=pid)
    assert live_holder(path) is None
    with Lease.acquire(path) as lease:
        assert lease.takeover == f"taking over from process {pid} on {lease.holder.host}: the process is gone"


def test_a_zombie_counts_as_gone(path: Path) -> None:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)  # ended, and not yet reaped
    write_holder(path, pid=child)
    try:
        Lease.acquire(path).release()
    finally:
        os.waitpid(child, 0)


def test_a_process_number_that_was_given_to_another_is_not_the_holder(path: Path) -> None:
    write_holder(path, process_start="1")
    with Lease.acquire(path) as lease:
        assert lease.takeover is not None
        assert "its number belongs to another process now" in lease.takeover


def test_a_holder_from_before_the_restart_is_taken_over(path: Path) -> None:
    write_holder(path, boot_id="an earlier one", age_s=3650 * ONE_DAY_S)
    with Lease.acquire(path) as lease:
        assert lease.takeover is not None
        assert "was restarted" in lease.takeover


@pytest.mark.parametrize(
    "elsewhere",
    [
        {"host": "another", "boot_id": "another"},
        {"pid_namespace": "another container of this machine"},
        {"boot_id": "another machine of the same name"},
    ],
    ids=["another host", "another container", "another host of the same name"],
)
def test_a_holder_elsewhere_is_judged_by_its_heartbeat(path: Path, elsewhere: dict[str, str]) -> None:
    write_holder(path, pid=1, **elsewhere)
    with pytest.raises(JobBusyError):
        Lease.acquire(path)
    write_holder(path, pid=1, age_s=EXPIRY_S + 30, **elsewhere)
    with Lease.acquire(path) as lease:
        assert lease.takeover is not None
        assert "it has not been heard of for 90 s" in lease.takeover


def test_an_illegible_lease_never_needs_a_person(path: Path) -> None:
    path.write_text("")
    with pytest.raises(JobBusyError, match="by an unknown process"):  # another machine may be writing it
        Lease.acquire(path)
    os.utime(path, (time.time() - EXPIRY_S - 30,) * 2)
    with Lease.acquire(path) as lease:
        assert lease.takeover is not None
        assert "taking over from an unknown process: its name is not legible" in lease.takeover


def test_a_heartbeat_renews_the_lease(path: Path) -> None:
    with Lease.acquire(path) as lease:
        os.utime(path, (0, 0))
        lease.heartbeat()
        assert abs(path.stat().st_mtime - time.time()) < EXPIRY_S


def test_a_holder_that_was_taken_over_learns_it_and_leaves_the_new_lease_alone(path: Path) -> None:
    with Lease.acquire(path) as old:
        newer = write_holder(path, token="another")
        with pytest.raises(LeaseLostError, match="was taken over by process"):
            old.heartbeat()
    assert read_holder(path) == newer


PATIENCE_S = 60.0  # heartbeats come every few milliseconds in these tests; only a hang gets there


def wait_until(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.005)


def test_the_heart_beats_while_the_holder_is_busy_with_something_else(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.base.lease.HEARTBEAT_INTERVAL_S", 0.01)
    with Lease.acquire(path) as lease:
        os.utime(path, (0, 0))
        wait_until(lambda: path.stat().st_mtime > 0)
        lease.check()


def test_a_holder_that_was_taken_over_is_told_so_when_it_asks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.base.lease.HEARTBEAT_INTERVAL_S", 0.01)

    def work_until_told(lease: Lease) -> None:
        wait_until(lambda: lease.check() is not None)

    with Lease.acquire(path) as old:
        newer = write_holder(path, token="another")
        with pytest.raises(LeaseLostError, match="was taken over by process"):
            work_until_told(old)
    assert read_holder(path) == newer


def test_a_lease_that_could_not_be_renewed_for_long_counts_as_lost(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.base.lease.HEARTBEAT_INTERVAL_S", 0.01)
    monkeypatch.setattr("pipeline.base.lease.EXPIRY_S", 0.05)

    def no_answer(_: Path) -> NoReturn:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))  # as when a network file system goes away

    with Lease.acquire(path) as lease:
        with monkeypatch.context() as away:
            away.setattr("pipeline.base.lease._guard", no_answer)
            wait_until(lambda: lease._loss is not None)
        with pytest.raises(LeaseLostError, match="could not be renewed"):
            lease.check()


def test_a_guard_is_removed_only_when_nobody_holds_the_lease(path: Path) -> None:
    guard = path.with_name(f".{path.name}.guard")
    with Lease.acquire(path):
        remove_guard(path)
        assert guard.exists()
    remove_guard(path)
    assert not guard.exists()


def wait_at_the_guard(path: str, reached: Any, answers: Any) -> None:
    reached.set()
    lease = Lease.acquire(Path(path))
    answers.put(read_holder(Path(path)) == lease.holder)


def test_who_waits_at_a_guard_that_is_removed_meanwhile_takes_the_new_one(path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    reached, answers = context.Event(), context.Queue()
    guard = path.with_name(f".{path.name}.guard")
    waiting = context.Process(target=wait_at_the_guard, args=(str(path), reached, answers))
    with guard.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        waiting.start()
        assert reached.wait(PATIENCE_S)
        wait_until(lambda: any(file.samefile(guard) for file in open_files_of(waiting.pid)))
        guard.unlink()
    assert answers.get(timeout=PATIENCE_S)
    waiting.join(timeout=PATIENCE_S)
    assert guard.exists()


def open_files_of(pid: int | None) -> list[Path]:
    return [link for link in Path(f"/proc/{pid}/fd").iterdir() if link.exists()]


def lock_nothing(_descriptor: Any, _operation: int) -> None:
    """As on a network file system whose locks end at the machine."""


def compete(path: str, barrier: Any, answers: Any, locks: bool) -> None:
    if not locks:
        fcntl.flock = lock_nothing
    barrier.wait()
    try:
        Lease.acquire(Path(path))
    except JobBusyError:
        answers.put("busy")
    else:
        answers.put("won")
    barrier.wait()  # alive until all have tried


@pytest.mark.parametrize("locks", [True, False], ids=["locks", "no locks"])
@pytest.mark.parametrize("dead", [True, False], ids=["dead", "free"])
def test_of_processes_that_race_for_a_lease_exactly_one_wins(path: Path, dead: bool, locks: bool) -> None:
    context = multiprocessing.get_context("spawn")
    racers = 4
    if dead:
        write_holder(path, pid=ended_process())
    barrier, answers = context.Barrier(racers), context.Queue()
    processes = [context.Process(target=compete, args=(str(path), barrier, answers, locks)) for _ in range(racers)]
    for process in processes:
        process.start()
    outcomes = sorted(answers.get(timeout=60) for _ in processes)
    for process in processes:
        process.join(timeout=60)
    assert outcomes == ["busy", "busy", "busy", "won"]
    assert {file.name for file in path.parent.iterdir()} == {path.name, f".{path.name}.guard"}


def successor_of(path: Path, dead: LeaseHolder) -> Path:
    return path.with_name(f".{path.name}.successor.part.{zlib.crc32(repr(dead).encode())}")


def test_who_died_while_it_took_a_lease_over_is_in_nobodys_way(path: Path) -> None:
    dead = write_holder(path, pid=ended_process())
    write_holder(successor_of(path, dead), pid=ended_process())
    with Lease.acquire(path) as lease:
        assert read_holder(path) == lease.holder
    assert not successor_of(path, dead).exists()


def test_without_hard_links_a_lease_is_had_by_who_makes_the_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(errno.EPERM, "this file system has no hard links")

    monkeypatch.setattr(os, "link", refuse)
    with Lease.acquire(path) as lease:
        assert read_holder(path) == lease.holder
        with pytest.raises(JobBusyError):
            Lease.acquire(path)
    write_holder(path, pid=ended_process())
    with Lease.acquire(path) as lease:
        assert read_holder(path) == lease.holder


@pytest.mark.parametrize("error_s", [-600.0, 600.0])
def test_clocks_of_machines_do_not_matter(path: Path, monkeypatch: pytest.MonkeyPatch, error_s: float) -> None:
    monkeypatch.setattr("time.time", lambda now=time.time: now() + error_s)
    guard = path.with_name(f".{path.name}.guard")
    guard.touch()
    holder = write_holder(path, pid=1, host="another", boot_id="another")
    os.utime(path)
    assert live_holder(path) == holder
    os.utime(path, (path.stat().st_mtime - EXPIRY_S - 30,) * 2)
    assert live_holder(path) is None


def test_a_holder_that_was_stopped_for_long_asks_before_it_goes_on(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Lease.acquire(path) as lease:
        monkeypatch.setattr("pipeline.base.lease.EXPIRY_S", -1.0)  # overdue, as after a long stop
        os.utime(path, (0, 0))
        lease.check()
        assert path.stat().st_mtime > 0
        newer = write_holder(path, token="another")
        with pytest.raises(LeaseLostError, match="was taken over by process"):
            lease.check()
    assert read_holder(path) == newer
