"""Two hosts, clocks ten minutes apart, with a folder whose names and attributes each caches, and locks end at each.

The whole, with partitions of the real length: `pytest -m "slow or nightly" tests/pipeline/queue/test_two_hosts.py`.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from farm_processes import Ended, wait_until
from places import PROJECT
from synthetic_jobs import contents, job_text, run_recorded
from two_hosts import Host, two_hosts, what_is_missing

from pipeline.base.errors import JobBusyError
from pipeline.base.lease import EXPIRY_S
from pipeline.base.task import TaskState
from pipeline.queue.job_queue import new_entry
from pipeline.record.reader import ManifestReader
from tests.campaign.studio import JOB, SCENES, is_artifact

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(what_is_missing()), reason=what_is_missing())]

FRAMES = 6
SOON_S = 6.0
"""After so long a host that is not heard of counts as dead in CI; twice as long as names are cached."""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    root = tmp_path_factory.mktemp("undisturbed") / "film"
    run_recorded(root, job_text(frames=FRAMES))
    return contents(root)


def succeeded(host: Host, name: str) -> Counter[str]:
    return Counter(row.task for row in host.attempts(name) if row.outcome == "succeeded")


def hosts_of(host: Host, name: str) -> set[str]:
    return {row.host for row in host.attempts(name)}


def assert_made_once(host: Host, name: str, undisturbed: dict[str, bytes]) -> None:
    """Nothing is missing or recorded twice, and nothing is left over."""
    root = host.layout(name).root
    assert contents(root) == undisturbed
    assert set(succeeded(host, name).values()) == {1}
    with ManifestReader.open_readonly(host.layout(name).manifest) as manifest:
        assert set(manifest.states().values()) <= {TaskState.SUCCEEDED, TaskState.UP_TO_DATE}
        assert set(manifest.artifacts()) == set(undisturbed)
    assert host.queue.listing().jobs == ()
    assert not [*root.rglob("*.part.*"), *root.glob("*.lease")]


def test_of_two_hosts_that_submit_one_job_at_once_one_runs_it(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    with two_hosts(tmp_path) as (_, ash, birch):
        job = str(ash.job("film", frames=FRAMES, pause_s=0.5))
        ended = [host.finish(process) for host, process in [(host, host.start("submit", job)) for host in (ash, birch)]]
        assert_made_once(ash, "film", undisturbed)
        (runner,) = hosts_of(ash, "film")
        assert sum(f" on {runner} since " in each.err for each in ended) == 1
        assert sum("report: " in each.err for each in ended) == 1
        assert len(ash.attempts("film")) == len(succeeded(ash, "film"))


def test_each_job_of_a_queue_that_two_hosts_work_runs_once_in_the_order_of_submission(
    tmp_path: Path, undisturbed: dict[str, bytes]
) -> None:
    with two_hosts(tmp_path) as (_, ash, birch):
        names = ["z", "y", "x"]
        for name in names:
            ash.job(name, frames=FRAMES, pause_s=0.05 if name != "z" else 0.3)
        submitting = [ash.start("submit", "z.toml")]
        wait_until(lambda: ash.is_running("z"), "the first job runs")
        # Clocks would have it the other way round.
        for host, name in ((ash, "y"), (birch, "x")):
            submitting.append(host.start("submit", f"{name}.toml"))
            wait_until(lambda name=name: bool(ash.queue.find(name)), "the job is queued")
        working = birch.start("work")
        for process in (*submitting, working):
            ash.finish(process)
        for name in names:
            assert_made_once(ash, name, undisturbed)
        began = [min(path.stat().st_mtime for path in ash.layout(name).root.glob("steps/*.bin")) for name in names]
        assert began == sorted(began)


def test_a_job_that_is_detached_while_the_runner_of_the_other_host_ends_is_run(
    tmp_path: Path, undisturbed: dict[str, bytes]
) -> None:
    with two_hosts(tmp_path) as (_, ash, birch):
        for name in ("first", "last"):
            ash.job(name, frames=FRAMES)
        ash.queue.put(new_entry("first", text=(ash.folder / "first.toml").read_text()))
        ash.stop_at(r"os\.remove .*/\.farm/runner\.lease$")
        birch.stop_at(r"os\.rename .*/\.farm/queue/last\.json$")
        ending, detaching = ash.start("work"), birch.start("submit", "last.toml", "--detach")
        wait_until(lambda: ash.stands() and birch.stands(), "one ends, and the other queues its job")
        ash.do("test", "!", "-e", "renders/.farm/queue/last.json")  # which its host remembers for a while
        os.killpg(detaching.pid, signal.SIGCONT)
        assert birch.finish(detaching).out.startswith("last is queued; the queue runs in the background\n")
        os.killpg(ending.pid, signal.SIGCONT)
        assert "the queue is empty" in ash.finish(ending).err
        for name in ("first", "last"):
            assert_made_once(ash, name, undisturbed)


@pytest.mark.nightly
def test_when_the_holders_host_loses_power_the_other_one_goes_on(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    with two_hosts(tmp_path, expiry_s=SOON_S) as (_, ash, birch):
        job = str(ash.job("film", frames=FRAMES, pause_s=0.2))
        ash.start("submit", job)
        wait_until(lambda: ash.frames_done("film") >= 2, "some frames are done")
        waiting = birch.start("submit", job)
        ash.lose_power()
        done = ash.commits()
        ended = birch.finish(waiting)
        assert "taking over from process" in ended.err
        assert_made_once(birch, "film", undisturbed)
        assert sorted(done + birch.commits()) == sorted(f"{artifact}.json" for artifact in undisturbed)


@pytest.mark.nightly
def test_a_film_of_every_kind_is_the_same_whichever_host_loses_power(tmp_path: Path) -> None:
    job = JOB.format(name="film", frames=FRAMES, scene=SCENES["all"], limits="")
    (tmp_path / "film.toml").write_text(job)
    command = ("-m", "pipeline", "submit", "film.toml")
    subprocess.run([sys.executable, *command], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(PROJECT)}, check=True)
    with two_hosts(tmp_path) as (_, ash, birch):
        (ash.folder / "film.toml").write_text(job)
        root = ash.layout("film").root
        ash.start_program(*command)
        wait_until(lambda: len([*root.glob("frames/*.png")]) >= 2, "some frames are drawn")
        waiting = birch.start_program(*command)
        ash.lose_power()
        ended = birch.finish(waiting)
        assert "taking over from process" in ended.err

        def made(folder: Path) -> dict[str, bytes]:
            return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if is_artifact(path)}

        assert made(root) == made(tmp_path / "renders" / "film")
        assert len(ash.commits() + birch.commits()) == len(set(ash.commits() + birch.commits()))


def cut_off_and_back(
    tmp_path: Path,
    undisturbed: dict[str, bytes],
    *,
    partition_s: float,
    expiry_s: float | None = None,
    soft_s: float = 0.0,
    pause_s: float = 0.4,
    moment_s: float = 0.0,
) -> tuple[Ended, Ended, set[str]]:
    """Cut off the host that runs a job which the other one waits for; how both ended, and who ran tasks."""
    with two_hosts(tmp_path, expiry_s=expiry_s, soft_s=soft_s) as (network, ash, birch):
        job = str(ash.job("film", frames=FRAMES, pause_s=pause_s))
        cut_off = ash.start("submit", job)
        wait_until(lambda: ash.is_running("film"), "it runs")
        waiting = birch.start("submit", job)
        wait_until(lambda: moment_s > 0.0 or ash.frames_done("film") >= 2, "some frames are done")
        time.sleep(moment_s)
        network.cut_for(0, partition_s)
        first, second = ash.finish(cut_off, code=None), birch.finish(waiting, code=None)
        if second.code:
            birch.run("submit", job)
        assert "Traceback" not in first.err + second.err
        assert_made_once(birch, "film", undisturbed)
        return first, second, hosts_of(birch, "film")


def test_a_host_that_was_cut_off_finds_its_job_taken_over(tmp_path: Path, undisturbed: dict[str, bytes]) -> None:
    first, second, hosts = cut_off_and_back(tmp_path, undisturbed, expiry_s=SOON_S, partition_s=1.5 * SOON_S)
    assert (first.code, second.code, hosts) == (JobBusyError.exit_code, 0, {"ash", "birch"})
    assert "was taken over by" in first.err
    assert "taking over from process" in second.err


@pytest.mark.nightly
@pytest.mark.parametrize("soft_s", [0.0, 5.0], ids=["hard", "soft"])
@pytest.mark.parametrize("partition_s", [30.0, 60.0, 90.0])
def test_a_partition_loses_nothing(
    tmp_path: Path, undisturbed: dict[str, bytes], partition_s: float, soft_s: float
) -> None:
    _, second, hosts = cut_off_and_back(tmp_path, undisturbed, partition_s=partition_s, soft_s=soft_s)
    assert second.code == 0 or soft_s  # calls that fail may fail a task; submitted again it succeeds
    if partition_s < EXPIRY_S and not soft_s:
        assert hosts == {"ash"}  # it only waited
    if partition_s > EXPIRY_S:
        assert hosts == {"ash", "birch"}


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(20))
def test_a_partition_at_any_moment_loses_nothing(tmp_path: Path, undisturbed: dict[str, bytes], seed: int) -> None:
    chance = random.Random(seed)
    cut_off_and_back(
        tmp_path,
        undisturbed,
        expiry_s=SOON_S,
        partition_s=chance.uniform(0.5, 2.0) * SOON_S,
        soft_s=chance.choice([0.0, 0.0, 1.0]),
        pause_s=chance.choice([0.0, 0.05, 0.3]),
        moment_s=chance.uniform(0.1, 3.0),
    )
