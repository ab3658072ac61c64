"""Damaged files, places that cannot be written to, physics gone wrong: a clear line, and nothing is lost."""

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from blake3 import blake3
from films import PATIENCE_S, PROJECT, STAGE_NAMES, Finished, Studio

# --- damaged files ---

ONE_OF_EACH_KIND = (
    "cache/000002.h5",
    "cloths/sheet/000005.ply",
    "frames/000003.png",
    "meshes/ball.ply",
    "movie.mp4",
    "movie/0000.mp4",
    "surfaces/water/000001.ply",
    "volumes/plume/000004.vdb",
)
THEIR_TASKS = {
    "bodies/ball",
    "cloth/sheet/000005",
    "movie/film",
    "movie/segment-0000",
    "render/000003",
    "simulate",
    "surface/water/000001",
    "volume/plume/000004",
}


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def flip_a_bit_unseen(path: Path) -> None:
    """As a failing disk does: the time of modification stays."""
    status = path.stat()
    flip_a_bit(path)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def delete(path: Path) -> None:
    path.unlink()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "options", "words"),
    [
        (truncate, (), "truncated"),
        (flip_a_bit, (), "its hash differs"),
        (flip_a_bit_unseen, ("--deep",), "its hash differs"),
        (delete, (), "file is missing"),
    ],
)
def test_damaged_files_are_named_and_just_they_would_be_made_again(
    finished: Studio, damage: Callable[[Path], None], options: tuple[str, ...], words: str
) -> None:
    for artifact in ONE_OF_EACH_KIND:
        damage(finished.layout.root / artifact)
    verified = finished.run("verify", "tiny", *options).assert_code(1)
    lines = verified.out.splitlines()
    assert tuple(line.partition(": ")[0] for line in lines[: len(ONE_OF_EACH_KIND)]) == ONE_OF_EACH_KIND
    assert all(words in line for line in lines[: len(ONE_OF_EACH_KIND)])
    planned = {
        each["task"]: each["reasons"]
        for each in json.loads(finished.run("plan", "tiny.toml", "--json").assert_code(0).out)
        if each["verdict"] == "stale"
    }
    assert planned.keys() == THEIR_TASKS
    assert all(len(reasons) == 1 for reasons in planned.values()), planned


@pytest.mark.slow
def test_damaged_files_are_made_again_and_kept_aside(finished: Studio, reference: Studio) -> None:
    """Of each kind of file that has a frame each, one is damaged in each way; the others in one way each."""
    ways = (truncate, flip_a_bit, flip_a_bit_unseen, delete)
    damages = {
        re.sub(r"00000\d", f"{frame:06d}", artifact): damage
        for artifact in ONE_OF_EACH_KIND
        if "/00000" in artifact
        for frame, damage in enumerate(ways, start=1)
    }
    damages |= {"meshes/ball.ply": truncate, "movie.mp4": flip_a_bit_unseen, "movie/0000.mp4": delete}
    for artifact, damage in damages.items():
        damage(finished.layout.root / artifact)
    damaged, attempts = finished.artifacts(), finished.attempts()
    finished.run("verify", "tiny", "--deep").assert_code(1)
    finished.submit()
    frames = [f"{frame:06d}" for frame in range(1, 1 + len(ways))]
    assert finished.tasks_run_since(attempts) == {
        *(task for task in THEIR_TASKS if "/00000" not in task),
        *(f"{task[:-6]}{frame}" for task in THEIR_TASKS if "/00000" in task for frame in frames),
    }
    finished.assert_whole(like=reference)
    finished.run("verify", "tiny", "--deep").assert_code(0)
    for artifact, damage in damages.items():
        edited = finished.layout.root / f"{artifact}.edited-1"
        assert edited.exists() == (damage is not delete), artifact
        if edited.exists():
            assert blake3(edited.read_bytes()).hexdigest() == damaged[artifact]


@pytest.mark.slow
def test_a_damaged_manifest_is_made_anew_of_the_receipts(finished: Studio, reference: Studio) -> None:
    garbled = b"this is no database" * 100
    finished.layout.manifest.write_bytes(garbled)
    *_, remedy = finished.run("plan", "tiny").assert_code(1).err.strip().partition("pipeline verify ")
    finished.run("verify", *remedy.split()).assert_code(0)
    finished.layout.manifest.write_bytes(garbled)
    submitted = finished.submit()
    assert submitted.out.startswith("up to date")
    assert "was damaged and is made anew of" in submitted.err
    finished.assert_whole(like=reference)


def test_a_manifest_that_was_never_finished_is_made_anew_as_well(finished: Studio) -> None:
    finished.layout.manifest.write_bytes(b"")  # as after kill -9, or on a full disk, in the first moment of a job
    assert "submit the job once" in finished.run("plan", "tiny.toml").assert_code(1).err
    assert finished.submit().out.startswith("up to date")
    finished.run("verify", "tiny").assert_code(0)


# --- places that cannot be written to ---

FILL_THE_DISK = """
    mount -t tmpfs -o size={size_kb}k films "$1" || exit 99
    cp -a prepared/. "$1" || exit 98
    shift
    "$@" > first.out 2> first.err
    echo $? > first.code
    mount -o remount,size=64m films
    "$@" > second.out 2> second.err
    echo $? > second.code
    cp -a renders kept
"""


def may_mount() -> bool:
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        return False
    attempt = ["unshare", "--mount", "mount", "-t", "tmpfs", "films", "/mnt"]
    return subprocess.run(attempt, check=False, capture_output=True).returncode == 0


def assert_a_full_disk_loses_nothing(studio: Studio, size_kb: int, like: Studio) -> str:
    """Submit what is in the folder `prepared` on a disk of this size, then on a larger one; returns what was said."""
    folder = studio.folder
    (folder / "renders").mkdir()
    command = [sys.executable, "-m", "pipeline", "submit", "tiny.toml"]
    script = textwrap.dedent(FILL_THE_DISK).format(size_kb=size_kb)
    subprocess.run(
        ["unshare", "--mount", "sh", "-c", script, "sh", str(folder / "renders"), *command],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        check=True,
        timeout=2 * PATIENCE_S,
    )
    first, second = (
        Finished(
            int((folder / f"{which}.code").read_text()),
            *((folder / f"{which}.{s}").read_text() for s in ("out", "err")),
        )
        for which in ("first", "second")
    )
    first.assert_code(7)
    assert "the disk is full" in first.err
    second.assert_code(0)
    (folder / "renders").rmdir()
    (folder / "kept").rename(folder / "renders")
    studio.assert_whole(like=like)
    return first.err


needs_mount = pytest.mark.skipif(not may_mount(), reason="only root may mount a small disk, in a namespace of its own")


@pytest.mark.slow
@needs_mount
@pytest.mark.parametrize("size_kb", [60, 250])
def test_a_full_disk_pauses_the_job_and_loses_nothing(empty: Studio, splash: Studio, size_kb: int) -> None:
    (empty.folder / "prepared").mkdir()
    assert_a_full_disk_loses_nothing(empty, size_kb, like=splash)
    empty.assert_nothing_done_twice()


@pytest.mark.slow
@needs_mount
def test_a_disk_that_fills_after_the_simulation_loses_nothing(finished: Studio, reference: Studio) -> None:
    stages = [stage for stage in STAGE_NAMES if stage not in ("bodies", "simulate")]
    finished.run("clean", "tiny", *(word for stage in stages for word in ("--stage", stage)), "--yes").assert_code(0)
    before = finished.attempts()
    prepared = (finished.folder / "renders").rename(finished.folder / "prepared")
    kept = int(subprocess.check_output(["du", "-sk", str(prepared)], text=True).split()[0])
    said = assert_a_full_disk_loses_nothing(finished, kept + 250, like=reference)
    assert "simulate 6/6" not in said
    finished.assert_nothing_done_twice(since=before)


@pytest.mark.parametrize("place", ["a file", "a file/films", "/proc/films"])
def test_a_place_that_cannot_be_written_to_is_refused_in_one_line(empty: Studio, place: str) -> None:
    (empty.folder / "a file").write_text("mine")
    refused = empty.run("submit", "tiny.toml", "--farm", place)
    assert refused.code in (1, 2)
    assert refused.out == ""
    [line] = [line for line in refused.err.splitlines() if line.startswith(("error: ", "Error: "))]
    assert place in line
    assert "Traceback" not in refused.err
    assert (empty.folder / "a file").read_text() == "mine"


# --- physics that goes wrong ---


@pytest.mark.slow
def test_a_simulation_that_diverges_says_where_and_a_smaller_step_mends_it(empty: Studio, splash: Studio) -> None:
    failed = empty.run("submit", "tiny.toml", "--set", "fluid.water.dt=0.02").assert_code(5)
    assert "simulate (attempt 1) diverged" in failed.err
    assert '"water"' in failed.err
    assert "frame" in failed.err
    assert [history[-1].outcome for task, history in empty.histories().items() if task == "simulate"] == ["diverged"]
    assert '(simulate: "water" diverged at frame' in empty.run("status", "tiny").out
    empty.submit()
    empty.assert_whole(like=splash)
