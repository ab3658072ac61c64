"""The simulation as a task, run for real: which device its frames come from, and what a kill or a full disk leaves."""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import killed_simulation
import pytest
from places import HELPERS, PROJECT
from simulation_on_a_full_disk import FRAMES as FRAMES_OF_FULL_DISK

from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.run.events import Failed, Finished, TaskEvent
from pipeline.store.artifacts import sweep_parts
from pipeline.store.cache import Checkpoint, read_frame, write_checkpoint, write_frame
from pipeline.store.receipts import is_committed
from sim.core import runtime

MODULES = os.pathsep.join([str(PROJECT), str(HELPERS)])
"""What scripts of these tests import from: the project, and what its tests share."""

JOB = """
name = "drop"
frames = {frames}

[[fluid]]
name = "water"
particle_radius = 0.04
[[fluid.block]]
shape = {{ type = "box", size = [0.3, 0.3, 0.3] }}
position = [0.0, 0.0, 0.3]
"""


DRAPE = """
name = "drop"
frames = {frames}

[[rigid]]
name = "ball"
kind = "dynamic"
density = 500.0
shape = {{ type = "sphere", radius = 0.08 }}
position = [0.0, 0.0, 0.3]
velocity = [0.0, 0.0, 1.0]

[[cloth]]
name = "sheet"                # meets the ball in its first frames, let go at one corner and led away at another
shape = {{ type = "rectangle", size = [0.5, 0.5], counts = [11, 11] }}
position = [0.0, 0.0, 0.4]
velocity = [0.0, 0.0, -1.0]
wind = [3.0, 0.0, 0.0]
[[cloth.pin]]
corner = "x-y-"
release_s = 0.04
[[cloth.pin]]
corner = "x+y+"
keyframe = [{{ time_s = 0.0 }}, {{ time_s = 0.1, offset = [0.05, 0.0, 0.1] }}]
"""
"""Cloth, a body and contacts, coupled both ways."""

RUBBLE = """
name = "drop"
frames = {frames}

[[rigid]]
name = "stone"
kind = "dynamic"
density = 2000.0
shape = {{ type = "box", size = [0.1, 0.08, 0.06] }}
count = 12
scales = [0.6, 1.0]
seed = 3
position = [0.0, 0.0, 0.25]
velocity = [0.0, 0.0, -2.0]
scatter = {{ shape = {{ type = "box", size = [0.5, 0.5, 0.4] }} }}
"""
"""A group that falls to the floor, where contacts are followed from frame to frame."""

PLUME = """
name = "drop"
frames = {frames}

[[smoke]]
name = "plume"
cell_size = 0.0625
[[smoke.source]]
shape = {{ type = "sphere", radius = 0.15 }}
position = [0.05, 0.0, 0.3]
"""
"""Its frames are rounded, and end around the smoke: continuing from them instead of a checkpoint would show."""


RISING = PLUME.replace("cell_size = 0.0625", 'cell_size = 0.0625\ngrid = "open"\nbuoyancy_temperature = 0.2')
"""It outgrows its box."""


def simulate(layout: JobLayout, *, frames: int, attempt: int = 1, job: str = JOB) -> TaskEvent:
    """Run the task of a job of so many frames until it ends; returns how it ended."""
    layout.root.mkdir(exist_ok=True)
    layout.job_file.write_text(job.format(frames=frames))
    return killed_simulation.simulate(layout, attempt=attempt)


@pytest.fixture
def layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobLayout:
    monkeypatch.setattr("sim.core.runtime.available_devices", lambda: {"cpu": "ok"})
    return JobLayout(tmp_path / "drop")


def test_frames_of_two_devices_are_not_mixed(layout: JobLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two frames from a machine with a GPU, whose checkpoint is gone, are continued on one without."""
    start = runtime.initialize
    with monkeypatch.context() as other_machine:
        # Only the name is another machine's: what it would compute is not what this is about.
        other_machine.setattr(
            "pipeline.stages.simulate.initialize", lambda device, **options: start(device, **options) and "cuda"
        )
        assert isinstance(simulate(layout, frames=2), Finished)
    former = read_frame(layout.path(layout.frame_cache(1)))
    assert former.device == "cuda"
    assert set(former.bodies["water"].arrays) == {"position", "velocity", "density", "pressure", "particle_id"}
    shutil.rmtree(layout.checkpoints)
    ended = simulate(layout, frames=3)
    assert isinstance(ended, Failed)
    assert "this job was simulated on cuda so far, and this machine offers cpu" in ended.message
    assert not layout.path(layout.frame_cache(2)).exists()


def test_frames_of_the_same_device_are_continued_without_a_checkpoint(layout: JobLayout) -> None:
    assert isinstance(simulate(layout, frames=2), Finished)
    shutil.rmtree(layout.checkpoints)
    assert isinstance(simulate(layout, frames=3), Finished)
    assert read_frame(layout.path(layout.frame_cache(2))).device == "cpu"


def frames_of(layout: JobLayout, count: int) -> list[bytes]:
    return [layout.path(layout.frame_cache(frame)).read_bytes() for frame in range(count)]


@pytest.mark.parametrize(
    ("write", "job"),
    [
        pytest.param("write_frame", JOB, id="frame"),
        pytest.param("write_checkpoint", JOB, id="checkpoint"),
        pytest.param("write_checkpoint", RUBBLE, id="checkpoint of a group"),
        pytest.param("write_checkpoint", DRAPE, id="checkpoint of cloth", marks=pytest.mark.slow),
        pytest.param("write_frame", PLUME, id="frame of smoke", marks=pytest.mark.slow),
    ],
)
def test_killed_in_the_middle_of_a_write_it_continues_to_the_same_frames(
    layout: JobLayout, write: str, job: str
) -> None:
    """Frames are written while later ones are computed: what is killed has computed more than it has written."""
    undisturbed = JobLayout(layout.root.with_name("undisturbed"))
    assert isinstance(simulate(undisturbed, frames=6, job=job), Finished)
    layout.root.mkdir()
    layout.job_file.write_text(job.format(frames=6))
    script = Path(killed_simulation.__file__)
    killed = subprocess.run(
        [sys.executable, script, layout.root, write, "3"],
        env={**os.environ, "PYTHONPATH": MODULES},
        timeout=120,
        check=False,
    )
    assert killed.returncode == -signal.SIGKILL
    committed = [frame for frame in range(6) if is_committed(layout, layout.frame_cache(frame), "f")]
    assert committed == ([0, 1, 2] if write == "write_frame" else [0, 1, 2, 3])
    # A checkpoint ahead of the frames would have to be thrown away, and the work before it be done again.
    assert sorted(path.name for path in layout.checkpoints.glob("[0-9]*.h5")) == ["000001.h5", "000002.h5"]
    sweep_parts(layout)
    assert isinstance(simulate(layout, frames=6, attempt=2, job=job), Finished)
    assert "starting at frame 2" in layout.log(killed_simulation.TASK, 2).read_text()
    assert frames_of(layout, 6) == frames_of(undisturbed, 6)


@pytest.mark.slow
def test_frame_1_made_again_alone_is_the_same(layout: JobLayout) -> None:
    """As after a kill between it and frame 0. Water with a sheet searches for neighbours where it is measured."""
    sheet = '[[cloth]]\nname = "sheet"\nshape = {{ type = "rectangle", size = [0.2, 0.2], counts = [5, 5] }}\n'
    job = f"{JOB}{sheet}position = [0.3, 0.0, 0.3]\n"
    assert isinstance(simulate(layout, frames=3, job=job), Finished)
    made_at_once = frames_of(layout, 3)
    shutil.rmtree(layout.checkpoints)
    layout.path(layout.frame_cache(1)).unlink()
    assert isinstance(simulate(layout, frames=3, attempt=2, job=job), Finished)
    assert frames_of(layout, 3) == made_at_once


SMALL_DISK = """
mount -t tmpfs -o size=400k tmpfs "$0" && head -c 250000 /dev/zero > "$0/ballast" &&
exec "$1" "$2" "$0/drop" "$0/ballast"
"""
"""Of a few pages, in a name space of its own, which needs no rights."""


def has_own_mounts() -> bool:
    """Whether this machine lets anybody mount something in a name space of his own."""
    return (
        shutil.which("unshare") is not None
        and not subprocess.run(
            ["unshare", "--user", "--map-root-user", "--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"],
            capture_output=True,
            check=False,
        ).returncode
    )


@pytest.mark.skipif(not has_own_mounts(), reason="this machine forbids user name spaces, or lacks unshare")
def test_a_disk_that_fills_up_stops_the_simulation_at_its_frame_and_costs_nothing(tmp_path: Path) -> None:
    """On a real full disk: HDF5 once left files open there, and ended the process with a segmentation fault."""
    script = Path(killed_simulation.__file__).with_name("simulation_on_a_full_disk.py")
    ended = subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", SMALL_DISK, tmp_path, sys.executable, script],
        env={**os.environ, "PYTHONPATH": MODULES},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout.splitlines()[-1])
    frames = len(told["committed"])
    assert told["committed"] == list(range(frames))
    assert 1 <= frames < FRAMES_OF_FULL_DISK
    assert told["kind"] == FailureKind.DISK_FULL.value
    assert told["message"] == f"OSError: [Errno 28] No space left on device; while frame {frames} was written"
    assert told["parts"] == told["checkpoints"] == []
    assert told["second"] == "Finished"
    assert told["committed_then"] == list(range(FRAMES_OF_FULL_DISK))


def test_a_disk_that_is_full_for_a_frame_is_told_as_such(layout: JobLayout, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill_up(path: Path, bodies, report, **options) -> None:
        if report.frame == 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write_frame(path, bodies, report, **options)

    with monkeypatch.context() as full_disk:
        full_disk.setattr("pipeline.stages.simulate.write_frame", fill_up)
        ended = simulate(layout, frames=6)
    assert isinstance(ended, Failed)
    assert ended.kind is FailureKind.DISK_FULL
    assert ended.message.endswith("; while frame 2 was written")
    assert not list(layout.checkpoints.glob("*.h5"))  # it would be ahead of the frames
    assert isinstance(simulate(layout, frames=6, attempt=2), Finished)


def test_a_smoke_that_outgrows_memory_ends_at_its_last_frame_and_goes_on_where_there_is_more(
    layout: JobLayout, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    whole = JobLayout(tmp_path / "whole")
    assert isinstance(simulate(whole, frames=40, job=RISING), Finished)
    with monkeypatch.context() as small_machine:
        small = MemoryBudget(20_000, "this machine")
        small_machine.setattr("pipeline.kinds.checks.smoke.memory_budget", lambda _job: small)
        ended = simulate(layout, frames=40, job=RISING)
    assert isinstance(ended, Failed)
    assert ended.kind is FailureKind.OUTGROWN
    numbers = r'smoke "plume" grows at [0-9.]+ s from [0-9,]+ to [0-9,]+ cells: [0-9,]+ more need .* at most 52 fit'
    assert re.fullmatch(numbers, ended.message), ended.message
    reached = len(list(layout.path(layout.frame_cache(0)).parent.glob("[0-9]*.h5")))
    assert 1 < reached < 40
    assert [path.stem for path in layout.checkpoints.glob("*.h5")] == [f"{reached - 1:06d}"]
    assert isinstance(simulate(layout, frames=40, attempt=2, job=RISING), Finished)
    assert frames_of(layout, 40) == frames_of(whole, 40)


def test_a_checkpoint_that_meets_a_full_disk_leaves_nothing_of_it(
    layout: JobLayout, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it had written so far would keep the disk full, until the job is run again."""

    def fill_up(path: Path, checkpoint: Checkpoint) -> None:
        write_checkpoint(path, checkpoint)
        os.truncate(path, path.stat().st_size // 2)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full_disk:
        full_disk.setattr("pipeline.stages.simulate.write_checkpoint", fill_up)
        ended = simulate(layout, frames=2)
    assert isinstance(ended, Failed)
    assert ended.kind is FailureKind.DISK_FULL
    assert ended.message.endswith("; while the checkpoint of frame 1 was written")
    assert list(layout.checkpoints.iterdir()) == []
