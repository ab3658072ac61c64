"""Films made on SLURM, by job arrays, Open Job Description's runner and Dask, and disturbed meanwhile.

Whatever happens, no finished task runs again, and the film is the same to the byte as one that `submit` makes.
"""

import re
import shlex
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from dask_processes import free_port
from films import FRAMES, SPLASH, Studio, finish, stage_of
from needed_blender import needs_bpy
from processes_seen import lives
from slurm_cluster import DEVICES, FILMS, GPU_NODE, SMALL, SlurmCluster, slurm_cluster, why_no_accounts, why_not

from pipeline.base.task import Resources
from pipeline.run.executors.choice import scheduler_address
from pipeline.run.executors.dask import DaskExecutor

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(why_not()), reason=why_not()), needs_bpy]
needs_accounts = pytest.mark.skipif(bool(why_no_accounts()), reason=why_no_accounts())

OPENJD = Path(sys.executable).with_name("openjd")
CPU = ("--set", "device=cpu", "--set", "render.device=cpu")
ROOM = ("--cpus-per-task=1", "--mem=2500M")
JOB = SPLASH.replace("[whitewater.water]\n", "").replace("[64, 36]", "[32, 18]")
BEGUN = {"simulate": ("cache", 2), "render": ("frames", 1)}
"""A stage is in the middle when as many files are in its folder."""


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SlurmCluster]:
    with slurm_cluster(tmp_path_factory.mktemp("slurm")) as cluster:
        yield cluster


@pytest.fixture
def cluster(slurm: SlurmCluster) -> Iterator[SlurmCluster]:
    """With all nodes idle, and nothing left of what a test began."""
    yield slurm
    slurm.clear()


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Studio:
    studio = Studio.open(tmp_path_factory.mktemp("reference"), JOB)
    studio.submit()
    return studio


# --- ways to make a film on SLURM ---


class Way:
    """A film that is being made by SLURM's jobs alone.

    `left`: how many frames the stage had still to commit when its process began to stand still.
    """

    def __init__(self, cluster: SlurmCluster, film: Studio) -> None:
        self.cluster, self.film = cluster, film
        self.left = 0
        film.run("export", "tiny.toml", "--to", "openjd", *CPU).assert_code(0)

    def begin(self) -> None:
        """Submit the jobs; also again, after one was ended."""
        raise NotImplementedError

    def wait_for_end(self) -> None:
        """Wait until nothing goes on by itself."""
        self.cluster.wait(lambda: not self.cluster.active(), "the jobs never end")

    def finish(self) -> None:
        """Wait for the film, and have it in the record."""
        self.wait_for_end()
        resumed = self.film.run("resume", "tiny").assert_code(0)
        assert resumed.out == "up to date: renders/tiny/movie.mp4\n", self.cluster.printed()

    def middle_of(self, stage: str) -> psutil.Process:
        """A process in the middle of a stage, standing still."""
        folder, count = BEGUN[stage]
        receipts = self.film.layout.receipts / folder
        begun = re.compile(rf"{stage}(?:/\d+)?, attempt \d+, on .*, process (\d+)$", re.MULTILINE)
        found: list[psutil.Process] = []

        def stands() -> bool:
            if len([*receipts.glob("*.json")]) >= count:
                with suppress(psutil.NoSuchProcess):
                    worker = psutil.Process(int(begun.findall(self.cluster.printed())[-1]))
                    worker.suspend()
                    found.append(worker)
                    self.left = FRAMES - len([*receipts.glob("*.json")])
            return bool(found)

        self.cluster.wait(stands, f"nothing was ever in the middle of {stage}")
        return found[0]

    def victim(self, worker: psutil.Process) -> psutil.Process:
        """The process that is to be killed."""
        return worker

    def is_told(self, worker: psutil.Process) -> bool:
        """Whether a process that stands still was told to end."""
        status = Path(f"/proc/{worker.pid}/status").read_text()
        [pending] = re.findall(r"^ShdPnd:\s*(\w+)$", status, re.MULTILINE)
        return bool(int(pending, 16) >> signal.SIGTERM - 1 & 1)


class StageArrays(Way):
    """`cluster/stages.sh`: a job for each stage, an array where frames are independent."""

    options: tuple[str, ...] = ROOM
    jobs: tuple[str, ...] = ()
    """Those submitted last."""

    def begin(self) -> None:
        submitted = self.cluster.run("cluster/stages.sh", self.film.layout.root, *self.options, PIPELINE_CHUNK="3")
        self.jobs = tuple(re.findall(r": job (\d+)", submitted))


class OpenJobDescription(Way):
    """The exported template, run by the reference runner in a job of SLURM's."""

    def begin(self) -> None:
        template = self.film.layout.root / "openjd.json"
        command = [OPENJD, "run", template, "--step", "movie", "--run-dependencies", "--job-param", "ChunkFrames=3"]
        self.cluster.sbatch(*ROOM, "--signal=B:TERM@50", "--wrap", f"exec {shlex.join(map(str, command))}")


class DaskWorkers(Way):
    """`cluster/scheduler.sbatch` and `cluster/cpu-workers.sbatch`, and a runner beside them."""

    runner: subprocess.Popen[str] | None = None

    def __init__(self, cluster: SlurmCluster, film: Studio) -> None:
        self.cluster, self.film = cluster, film

    def begin(self) -> None:
        place = {"PIPELINE_SHARED": str(self.film.folder), "PIPELINE_PORT": str(free_port())}
        if self.runner is None:
            self.cluster.sbatch("--mem=500M", "cluster/scheduler.sbatch", **place)
            scheduler_file = self.film.folder / "scheduler.json"
            self.cluster.wait(scheduler_file.exists, "the scheduler never came up")
            self.runner = self.film.start("submit", "tiny.toml", "--scheduler", str(scheduler_file), *CPU)
        for _ in range(2):
            self.cluster.sbatch(*ROOM, "cluster/cpu-workers.sbatch", **place)

    def wait_for_end(self) -> None:
        """The runner waits for other workers."""

    def finish(self) -> None:
        assert self.runner is not None
        finish(self.runner).assert_code(0)

    def middle_of(self, stage: str) -> psutil.Process:
        assert self.runner is not None
        found = self.film.wait_for_attempt(self.runner, [stage])
        assert found is not None, finish(self.runner)
        worker = psutil.Process(found[1])
        worker.suspend()
        return worker

    def victim(self, worker: psutil.Process) -> psutil.Process:
        return next(parent for parent in worker.parents() if "worker" in parent.cmdline())

    def is_told(self, worker: psutil.Process) -> bool:  # noqa: ARG002
        return "Stopping worker at tcp" in self.cluster.printed()


# --- what happens to them ---


def is_killed(way: Way, worker: psutil.Process) -> None:
    way.victim(worker).kill()


def is_cancelled(way: Way, worker: psutil.Process) -> None:
    way.cluster.run("scancel", way.cluster.job_of(worker))


def loses_its_node(way: Way, worker: psutil.Process) -> None:
    way.cluster.set_node(way.cluster.node_of(way.cluster.job_of(worker)), "down")


def has_its_node_drained(way: Way, worker: psutil.Process) -> None:
    way.cluster.set_node(way.cluster.node_of(way.cluster.job_of(worker)), "drain")
    worker.resume()


def is_out_of_time(way: Way, worker: psutil.Process) -> None:
    """Two minutes before the end SLURM says so: at once."""
    job = way.cluster.job_of(worker)
    way.cluster.run("scontrol", "update", f"JobId={job}", "TimeLimit=2")
    way.cluster.wait(lambda: way.is_told(worker), "SLURM never said that the time is over")
    worker.resume()


def is_warned(way: Way, worker: psutil.Process) -> None:
    """As SLURM does before the time is over, which takes it up to half a minute."""
    way.cluster.run("scancel", "--batch", "--signal=USR1", way.cluster.job_of(worker))
    way.cluster.wait(lambda: way.is_told(worker), "the warning never came")
    worker.resume()


@pytest.mark.parametrize(
    ("way", "stage", "happens", "ends"),
    [
        (StageArrays, "simulate", is_warned, False),
        (OpenJobDescription, "render", is_cancelled, True),
        (DaskWorkers, "simulate", loses_its_node, False),
        *(
            pytest.param(way, stage, happens, ends, marks=pytest.mark.nightly)
            for way, stage, happens, ends in [
                (StageArrays, "render", is_killed, True),
                (StageArrays, "render", is_cancelled, True),
                (StageArrays, "simulate", is_cancelled, True),
                (StageArrays, "simulate", loses_its_node, False),
                (StageArrays, "simulate", has_its_node_drained, False),
                (StageArrays, "simulate", is_out_of_time, False),
                (StageArrays, "render", is_warned, False),
                (OpenJobDescription, "render", is_killed, True),
                (OpenJobDescription, "simulate", loses_its_node, False),
                (OpenJobDescription, "simulate", has_its_node_drained, False),
                (OpenJobDescription, "simulate", is_out_of_time, True),
                (DaskWorkers, "render", is_killed, False),
                (DaskWorkers, "render", is_cancelled, True),
                (DaskWorkers, "simulate", has_its_node_drained, False),
                (DaskWorkers, "render", is_out_of_time, False),
            ]
        ),
    ],
)
def test_a_film_on_slurm_is_the_same_whatever_happens(
    cluster: SlurmCluster,
    reference: Studio,
    tmp_path: Path,
    way: type[Way],
    stage: str,
    happens: Callable[[Way, psutil.Process], None],
    ends: bool,
) -> None:
    """`ends`: it does not go on by itself, somebody has to begin it again."""
    making = way(cluster, Studio.open(tmp_path, JOB))
    making.begin()
    worker = making.middle_of(stage)
    node = cluster.node_of(cluster.job_of(worker))
    before = cluster.begun_on(node)
    happens(making, worker)
    cluster.wait(lambda: not lives(worker), "what was ended lives on")
    if ends:
        making.wait_for_end()
        making.begin()
    making.finish()
    making.film.assert_whole(like=reference)
    numbers = Counter(task for task, _, _ in making.film.layout.logs())
    again = [stage_of(task) for task, number in numbers.items() if number > 1]
    if happens is has_its_node_drained:
        assert again == []
        assert cluster.begun_on(node) == before
    elif way is DaskWorkers:  # the runner may give another task to a worker that is about to leave
        making.film.assert_nothing_done_twice()
    else:  # what stood still between two frames has none to draw again; what was in its last one ends it
        assert again == [stage] or (again == [] and (stage == "render" or making.left <= 1))
    if happens in (is_warned, is_out_of_time) and again == ["simulate"]:
        assert re.search(r"starting at frame [1-9]", cluster.printed())


@pytest.mark.parametrize("task", [0, 1])
def test_a_task_of_an_array_that_is_out_of_time_begins_again_alone(
    cluster: SlurmCluster, tmp_path: Path, task: int
) -> None:
    """The last one too, whose number is the array's."""
    work = tmp_path / "work"
    work.write_text("#!/bin/sh\necho begun\nexec sleep 600\n")
    work.chmod(0o755)
    command = ("cluster/stage-array.sbatch", tmp_path, "render", "0-2", "3-5")
    array = cluster.sbatch(*ROOM, "--array=0-1", *command, PIPELINE_RUN=str(work))
    cluster.wait(lambda: cluster.printed().count("begun") == 2, "the tasks never begin")
    cluster.run("scancel", "--batch", "--signal=USR1", f"{array}_{task}")
    cluster.wait(lambda: cluster.restarts(f"{array}_{task}") == 1, "SLURM never takes it back")
    assert cluster.restarts(f"{array}_{1 - task}") == 0


@needs_accounts
@pytest.mark.nightly
def test_the_accounts_tell_that_each_stage_is_done(cluster: SlurmCluster, reference: Studio, tmp_path: Path) -> None:
    making = StageArrays(cluster, Studio.open(tmp_path, JOB))
    making.options = (*ROOM, f"--account={FILMS}")
    making.begin()
    making.finish()
    making.film.assert_whole(like=reference)
    stages = ("bodies", "movie", "render", "render", "simulate", "surface", "surface")
    done = [f"pipeline-{stage}|{FILMS}|COMPLETED" for stage in stages]
    cluster.wait(lambda: cluster.booked(making.jobs) == done, "the accounts never tell it")


@needs_accounts
@pytest.mark.parametrize(("account", "words"), [("unknown", "Invalid account"), (SMALL, "job submit limit")])
def test_what_slurm_refuses_leaves_nothing_behind(
    cluster: SlurmCluster, tmp_path: Path, account: str, words: str
) -> None:
    making = StageArrays(cluster, Studio.open(tmp_path, JOB))
    making.options = (*ROOM, f"--account={account}", "--hold")
    with pytest.raises(AssertionError, match=words):
        making.begin()
    assert cluster.active() == set()


@needs_accounts
@pytest.mark.nightly
def test_a_stage_without_enough_memory_goes_on_with_more(
    cluster: SlurmCluster, reference: Studio, tmp_path: Path
) -> None:
    """Frames of Blender's need some 360 MB, all before them less."""
    making = StageArrays(cluster, Studio.open(tmp_path, JOB))
    making.options = ("--cpus-per-task=1", "--mem=300M")
    making.begin()
    making.wait_for_end()
    assert "exceeded memory limit" in cluster.printed()
    done = making.film.mtimes_ns()
    making.options = ROOM
    making.begin()
    making.finish()
    making.film.assert_whole(like=reference)
    assert done.items() <= making.film.mtimes_ns().items()


def test_workers_by_the_template_for_gpus_offer_one_each(cluster: SlurmCluster, tmp_path: Path) -> None:
    place = {"PIPELINE_SHARED": str(tmp_path), "PIPELINE_PORT": str(free_port())}
    cluster.sbatch("--mem=500M", "cluster/scheduler.sbatch", **place)
    scheduler_file = tmp_path / "scheduler.json"
    cluster.wait(scheduler_file.exists, "the scheduler never came up")
    job = cluster.sbatch("--ntasks=2", "--cpus-per-task=1", "--mem-per-cpu=700M", "cluster/gpu-workers.sbatch", **place)
    with DaskExecutor(scheduler_address(str(scheduler_file)), tmp_path, patience_s=60.0) as executor:
        both = Resources(2, 1_400_000_000, len(DEVICES))

        def are_there() -> bool:
            list(executor.wait(0.1))
            return executor.capacity == both

        cluster.wait(are_there, f"{executor.capacity} instead of {both}")
    assert cluster.node_of(job) == GPU_NODE
    assert cluster.gpus_of(job) == {"0", "1"}
