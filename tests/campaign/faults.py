"""What goes wrong: each kind of fault, how it is put in, and how it passes."""

import contextlib
import ctypes
import errno
import os
import random
import signal
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import psutil

from .family import Family
from .studio import Studio, is_artifact

BALLOON_BYTES = 2_500_000_000
"""More than the job's limit on memory."""
ROOM_BYTES = 256 << 20
_MS_REC_PRIVATE = (1 << 14) | (1 << 18)
_CLONE_NEWNS = 0x00020000


@dataclass
class Situation:
    """What a fault acts on.

    Attributes:
        studio: where the job is.
        family: all processes.
        chance: the campaign's generator.
        runner: process number of the runner, None between two runs.
        may_mount: small disks can be mounted.
        harmed: artifacts that were damaged in this round, and may be made again for it.
    """

    studio: Studio
    family: Family
    chance: random.Random
    runner: int | None = None
    may_mount: bool = False
    harmed: set[str] = field(default_factory=set)
    stopped: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    Attributes:
        name: for the table.
        inject: puts it in; False if there is nothing to act on at this moment.
        relieve: lets it pass; None: nothing has to.
        lasts_s: shortest and longest time until it passes [s]; None: until the run has ended.
        role: the process that a kill is meant for; steps within it are moments, too.
        between_runs: the runner is killed first.
        own_disk: the job's folder lies on a small disk of its own, where one can be mounted.
    """

    name: str
    inject: Callable[[Situation], bool]
    relieve: Callable[[Situation], None] | None = None
    lasts_s: tuple[float, float] | None = None
    role: str | None = None
    between_runs: bool = False
    own_disk: bool = False


# --- signals ---


def _signal_runner(*numbers: signal.Signals) -> Callable[[Situation], bool]:
    def inject(situation: Situation) -> bool:
        if situation.runner is None:
            return False
        for number in numbers:
            os.kill(situation.runner, number)
        return True

    return inject


def _signal_one(of: Callable[[Family], list[psutil.Process]], number: signal.Signals) -> Callable[[Situation], bool]:
    def inject(situation: Situation) -> bool:
        found = of(situation.family)
        if number is signal.SIGSTOP:  # one that stands still already is not stopped again
            found = [each for each in found if each.is_running() and each.status() != psutil.STATUS_STOPPED]
        if not found:
            return False
        target = situation.chance.choice(sorted(found, key=lambda each: each.pid))
        try:
            target.send_signal(number)
        except psutil.NoSuchProcess:
            return False
        if number is signal.SIGSTOP:
            situation.stopped.append(target.pid)
        return True

    return inject


def _kill_all(situation: Situation) -> bool:
    """As the end of a container does: nobody is left to clear up."""
    if situation.runner is None:
        return False
    for each in situation.family.living():
        with contextlib.suppress(psutil.NoSuchProcess):
            each.kill()
    return True


def _stop_runner(situation: Situation) -> bool:
    if situation.runner is None:
        return False
    os.kill(situation.runner, signal.SIGSTOP)
    situation.stopped.append(situation.runner)
    return True


def _go_on(situation: Situation) -> None:
    living = {each.pid for each in situation.family.living()}
    for pid in situation.stopped:
        if pid in living:
            os.kill(pid, signal.SIGCONT)
    situation.stopped.clear()


def _leave_stopped(situation: Situation) -> None:
    situation.stopped.clear()


# --- damage ---


def _damage(change: Callable[[Path, random.Random], None], *, unseen: bool = False) -> Callable[[Situation], bool]:
    def inject(situation: Situation) -> bool:
        root = situation.studio.root
        whole = sorted(path for path in root.rglob("*") if is_artifact(path))
        if not whole:
            return False
        path = situation.chance.choice(whole)
        _change(path, change, situation.chance, unseen=unseen)
        situation.harmed.add(path.relative_to(root).as_posix())
        return True

    return inject


def _damage_books(situation: Situation) -> bool:
    """Receipts and checkpoints: what the next run goes by."""
    root = situation.studio.root
    books = sorted([*(root / ".receipts").rglob("*.json"), *root.glob("cache/checkpoints/*.h5")])
    if not books:
        return False
    path = situation.chance.choice(books)
    change = situation.chance.choice([truncate, flip_a_bit])
    _change(path, change, situation.chance, unseen=situation.chance.random() < 0.5)
    if path.suffix == ".json":
        situation.harmed.add(path.relative_to(root / ".receipts").as_posix().removesuffix(".json"))
    return True


def truncate(path: Path, chance: random.Random) -> None:
    """Cut a file off anywhere."""
    os.truncate(path, chance.randrange(path.stat().st_size))


def flip_a_bit(path: Path, chance: random.Random) -> None:
    """Turn one bit over, anywhere."""
    content = bytearray(path.read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    path.write_bytes(content)


def _change(path: Path, change: Callable[[Path, random.Random], None], chance: random.Random, *, unseen: bool) -> None:
    status = path.stat()
    change(path, chance)
    if unseen:
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def _look_deeply(situation: Situation) -> None:
    """What changed without a trace in the file's times is found by a deep look; the next submit heals it."""
    verified = situation.family.adopt(situation.studio.start("verify", "tiny", "--deep"))
    verified.returncode = situation.family.wait(verified.pid, 300.0)


# --- places ---


def may_mount() -> bool:
    """Whether this process could enter a space of mounts of its own, where it may mount small disks."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNS) != 0:
        return False
    return libc.mount(b"none", b"/", None, _MS_REC_PRIVATE, None) == 0


def mount_disk(folder: Path) -> None:
    """A disk in memory; it goes with its last process."""
    _mount("-t", "tmpfs", "-o", f"size={ROOM_BYTES}", "campaign", str(folder))


def _fill_disk(situation: Situation) -> bool:
    if not situation.studio.root.exists():
        return False
    if situation.may_mount:
        status = os.statvfs(situation.studio.renders)
        used = (status.f_blocks - status.f_bfree) * status.f_frsize
        size = max(4096, used + situation.chance.choice([0, 4096, 16384, 65536]))
        try:
            _mount("-o", f"remount,size={size}", "campaign", str(situation.studio.renders))
        except subprocess.CalledProcessError:  # more was written meanwhile than it may shrink to
            return False
    else:
        situation.studio.tell("refuse", str(errno.ENOSPC))
    return True


def _give_room(situation: Situation) -> None:
    if situation.may_mount:
        _mount("-o", f"remount,size={ROOM_BYTES}", "campaign", str(situation.studio.renders))
    situation.studio.untell("refuse")


def _mount(*arguments: str) -> None:
    subprocess.run(["mount", *arguments], check=True, capture_output=True)


def _forbid_writing(situation: Situation) -> bool:
    return _set_modes(situation.studio, 0o555)


def _allow_writing(situation: Situation) -> None:
    _set_modes(situation.studio, 0o755)


def _set_modes(studio: Studio, mode: int) -> bool:
    folders = [each for each in (studio.root, *studio.root.rglob("*")) if each.is_dir()]
    for each in folders:
        each.chmod(mode)
    return bool(folders) and studio.root.exists()


def _refuse_writes(situation: Situation) -> bool:
    """As a file system does that the kernel has made read-only after an error: files that are open, too, stay so."""
    situation.studio.tell("refuse", str(errno.EROFS))
    return True


def _allow_writes(situation: Situation) -> None:
    situation.studio.untell("refuse")


def _blow_up(situation: Situation) -> bool:
    situation.studio.tell("balloon", str(BALLOON_BYTES))
    return True


def _turn_clock(situation: Situation) -> bool:
    jump = situation.chance.choice([-1.0, 1.0]) * 10.0 ** situation.chance.uniform(0.0, 9.0)
    situation.studio.tell("clock", str(jump))
    return True


KINDS = (
    Kind("disk full", _fill_disk, _give_room, own_disk=True),
    Kind("kill -9 of the runner", _signal_runner(signal.SIGKILL), role="runner"),
    Kind("kill -9 of all processes at once", _kill_all),
    Kind("folder read-only for a while", _forbid_writing, _allow_writing, (0.2, 3.0)),
    Kind("file system refuses writes", _refuse_writes, _allow_writes, (0.2, 3.0)),
    Kind("kill -9 of a worker", _signal_one(Family.workers, signal.SIGKILL), role="worker"),
    Kind("bit of an output flipped, unseen", _damage(flip_a_bit, unseen=True), _look_deeply, between_runs=True),
    Kind("receipt or checkpoint damaged", _damage_books, between_runs=True),
    Kind("kill -9 of Blender", _signal_one(Family.blenders, signal.SIGKILL)),
    Kind("clock jumps", _turn_clock),
    Kind("worker stopped for ever", _signal_one(Family.workers, signal.SIGSTOP), _leave_stopped, (0.0, 0.0)),
    Kind("SIGTERM to the runner", _signal_runner(signal.SIGTERM)),
    Kind("output truncated", _damage(truncate), between_runs=True),
    Kind("runner stopped for a while", _stop_runner, _go_on, (0.5, 3.0)),
    Kind("bit of an output flipped", _damage(flip_a_bit), between_runs=True),
    Kind("Ctrl-C twice", _signal_runner(signal.SIGINT, signal.SIGINT)),
    Kind("worker stopped for a while", _signal_one(Family.workers, signal.SIGSTOP), _go_on, (0.5, 3.0)),
    Kind("SIGTERM to a worker", _signal_one(Family.workers, signal.SIGTERM)),
    Kind("a worker's memory runs away", _blow_up),
)
