"""The scripts for SLURM, run as SLURM runs them; and TLS."""

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import psutil
import pytest
from dask_processes import HOST, free_port, running
from distributed import Client, Worker, WorkerPlugin
from farm_processes import wait_until
from places import HELPERS, PROJECT
from processes_seen import words_of
from synthetic_jobs import contents, run_synthetic

from pipeline.base.task import Resources
from pipeline.run.events import JobOutcome
from pipeline.run.executors.dask import ClusterError, DaskExecutor
from pipeline.run.executors.inline import InlineExecutor

CLUSTER = PROJECT / "cluster"
PATIENCE_S = 90.0
DEATH_TIMEOUT_S = 60.0
"""After which a worker that finds no scheduler begins anew."""
CERTIFICATE = (
    *("openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=farm"),
    *("-addext", "keyUsage=digitalSignature,keyCertSign", "-keyout", "farm.key", "-out", "farm.pem"),
)


@pytest.fixture
def environment(tmp_path) -> dict[str, str]:
    """As on a login node: a shared folder, and stand-ins for `./run` and `srun`."""
    for name, body in {"run": 'exec "$@"', "srun": 'exec "$@"'}.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{body}\n")
        (tmp_path / name).chmod(0o755)
    path = os.pathsep.join([str(tmp_path), str(Path(sys.executable).parent), os.environ["PATH"]])
    return {
        **os.environ,
        "PATH": path,
        "PYTHONPATH": os.pathsep.join([str(HELPERS), *sys.path]),
        "PIPELINE_RUN": str(tmp_path / "run"),
        "PIPELINE_SHARED": str(tmp_path),
        "PIPELINE_CLUSTER": str(CLUSTER),
        "PIPELINE_PORT": str(free_port()),
        "SLURM_CPUS_PER_TASK": "2",
        "SLURM_MEM_PER_NODE": "3000",
        "SLURM_MEM_PER_CPU": "500",
    }


def start(script: str, environment: dict[str, str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(["bash", str(CLUSTER / script)], env=environment, stdout=subprocess.DEVNULL)


def start_worker(environment: dict[str, str], stderr: IO[bytes] | None = None) -> subprocess.Popen[bytes]:
    command = ["bash", str(CLUSTER / "worker.sh"), "CPU=1", "MEM=2e9"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=stderr)


@pytest.fixture
def scheduler(environment) -> Iterator[str]:
    with running(start("scheduler.sbatch", environment)):
        yield f"tcp://{HOST}:{environment['PIPELINE_PORT']}"


@pytest.mark.parametrize(
    ("script", "offer"),
    [
        ("cpu-workers.sbatch", Resources(2, 3_000_000_000, 0)),
        pytest.param("gpu-workers.sbatch", Resources(2, 1_000_000_000, 1), marks=pytest.mark.slow),
    ],
)
def test_workers_offer_what_slurm_gives_and_leave_on_sigterm(tmp_path, environment, scheduler, script, offer):
    with running(start(script, environment)) as workers:
        with DaskExecutor(scheduler, tmp_path, patience_s=PATIENCE_S) as executor:
            assert executor.capacity == offer
        family = psutil.Process(workers.pid).children(recursive=True)
        workers.send_signal(signal.SIGTERM)
        assert workers.wait(PATIENCE_S) == 0
        assert psutil.wait_procs(family, PATIENCE_S)[1] == []


class SlowPlugin(WorkerPlugin):
    """Stands for tasks that write a checkpoint while their worker leaves."""

    async def teardown(self, worker: Worker) -> None:  # noqa: ARG002 - the signature is Dask's
        await asyncio.sleep(2.0)


@pytest.mark.slow
def test_a_worker_that_is_told_twice_to_leave_takes_its_time_all_the_same(tmp_path, environment, scheduler):
    """SLURM tells the script and the worker, and the script tells the worker."""
    log = tmp_path / "worker.log"
    with log.open("wb") as lines, running(start_worker(environment, stderr=lines)) as script:
        with Client(scheduler) as client:
            client.wait_for_workers(1, timeout=PATIENCE_S)
            client.register_plugin(SlowPlugin())
        [dask] = psutil.Process(script.pid).children()
        dask.terminate()
        wait_until(lambda: "Stopping worker" in log.read_text(), "it never leaves")
        script.terminate()
        assert script.wait(PATIENCE_S) == 0
    assert "End worker" in log.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("begun", ["sleep", "dask"])
def test_a_worker_that_is_told_to_leave_before_it_is_up_leaves(tmp_path, environment, begun):
    """While it waits for the scheduler's file, or looks for the scheduler."""
    if begun == "dask":
        (tmp_path / "scheduler.json").write_text(json.dumps({"address": f"tcp://{HOST}:{free_port()}"}))
    with running(start_worker(environment)) as script:

        def has_begun() -> bool:
            return any(begun in word for child in psutil.Process(script.pid).children() for word in words_of(child))

        wait_until(has_begun, "it never begins")
        script.terminate()
        assert script.wait(DEATH_TIMEOUT_S / 2) == 0


@pytest.mark.slow
def test_a_worker_comes_back_when_its_scheduler_was_restarted(tmp_path, environment):
    address = f"tcp://{HOST}:{environment['PIPELINE_PORT']}"
    with running(start("scheduler.sbatch", environment)) as first:
        workers = start("cpu-workers.sbatch", environment)
        with DaskExecutor(address, tmp_path, patience_s=PATIENCE_S):
            pass
        first.kill()
        first.wait()
    try:
        with (
            running(start("scheduler.sbatch", environment)),
            DaskExecutor(address, tmp_path, patience_s=PATIENCE_S) as executor,
        ):
            assert executor.capacity.cores == 2
    finally:
        workers.terminate()
        workers.wait(PATIENCE_S)


@pytest.mark.slow
def test_with_tls_a_job_runs_and_nobody_without_a_certificate_gets_in(tmp_path, environment):
    subprocess.run(CERTIFICATE, cwd=tmp_path, check=True, capture_output=True)
    names = {"CERT": str(tmp_path / "farm.pem"), "KEY": str(tmp_path / "farm.key")}
    settings = {
        "DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION": "True",
        "DASK_DISTRIBUTED__COMM__TLS__CA_FILE": names["CERT"],
        **{
            f"DASK_DISTRIBUTED__COMM__TLS__{role}__{key}": value
            for role in ("SCHEDULER", "WORKER", "CLIENT")
            for key, value in names.items()
        },
    }
    encrypted = {**environment, **settings}
    port = environment["PIPELINE_PORT"]
    command = ["dask", "scheduler", "--protocol", "tls", "--host", HOST, "--port", port, "--no-dashboard"]
    command += ["--scheduler-file", str(tmp_path / "scheduler.json")]
    program = (
        "import sys; from pathlib import Path\n"
        "from synthetic_jobs import run_synthetic\n"
        "from pipeline.run.executors.dask import DaskExecutor\n"
        "root = Path(sys.argv[1])\n"
        "root.mkdir()\n"
        "with DaskExecutor(sys.argv[2], root, patience_s=90.0) as executor:\n"
        "    print(run_synthetic(root, executor, capacity=executor.capacity, machine=executor.machine).kind)\n"
    )
    with (
        running(subprocess.Popen(command, env=encrypted, stderr=subprocess.DEVNULL)),
        running(start_worker(encrypted)) as loop,
    ):
        job = [sys.executable, "-c", program, str(tmp_path / "job"), f"tls://{HOST}:{port}"]
        ran = subprocess.run(job, env=encrypted, capture_output=True, text=True, check=False)
        assert ran.stdout.splitlines()[-1:] == [JobOutcome.SUCCEEDED.value], ran.stdout + ran.stderr
        for stranger in (f"tls://{HOST}:{port}", f"tcp://{HOST}:{port}"):
            with pytest.raises(ClusterError):
                DaskExecutor(stranger, tmp_path, patience_s=5.0)
        loop.terminate()
        loop.wait(PATIENCE_S)
    with InlineExecutor() as executor:
        run_synthetic(tmp_path / "undisturbed", executor)
    assert contents(tmp_path / "job") == contents(tmp_path / "undisturbed")
