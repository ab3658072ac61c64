"""A SLURM cluster of this machine alone, in a folder: Debian's munged, slurmctld, and a slurmd for each node.

Where slurmdbd and MariaDB are installed it has accounts too, as real sites have.
"""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import psutil
from dask_processes import HOST, free_port, running
from farm_processes import wait_until
from places import PROJECT

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")
ACCOUNTANTS = ("slurmdbd", "mariadbd", "mariadb-install-db", "my_print_defaults")
PATH = os.pathsep.join([os.environ["PATH"], "/usr/sbin"])
NODES = ("node1", "node2", "node3")
GPU_NODE = NODES[-1]
DEVICES = ("/dev/null", "/dev/zero")
"""What SLURM takes for the two GPUs of that node: it wants device files, and counts them."""

CONFIGURATION = """\
ClusterName=test
SlurmctldHost=localhost
SlurmctldPort={port}
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmctldPidFile={folder}/slurmctld.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdPidFile={folder}/%n.pid
SlurmdLogFile={folder}/%n.log
SlurmdSpoolDir={folder}/%n
SlurmdParameters=config_overrides
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
GresTypes=gpu
KillWait=5
SchedulerParameters=sched_interval=2,batch_sched_delay=0
{nodes}
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
"""Nothing leaves the machine. A job that SLURM takes back begins again after `cred_expire` seconds, 120 as a rule."""

ACCOUNTING = """\
AccountingStorageType=accounting_storage/slurmdbd
AccountingStoragePort={port}
AccountingStoragePass={folder}/munge.socket
AccountingStorageEnforce=associations,limits,qos
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=1
JobAcctGatherParams=OverMemoryKill
"""
"""Every second SLURM looks whether a job has more memory than it asked for, and ends it."""

DATABASE = """\
DbdHost=localhost
DbdPort={port}
CommunicationParameters=NoInAddrAny
SlurmUser=root
AuthInfo=socket={folder}/munge.socket
PidFile={folder}/slurmdbd.pid
StorageType=accounting_storage/mysql
StorageUser=root
"""

FILMS, SMALL = "films", "small"
"""The second is for three jobs, too few for a film."""

ROOM = "CPUs=2 RealMemory=4000"
"""What each node offers, whatever the machine has."""


def why_not() -> str:
    """Why no cluster can be started here; empty if one can."""
    if missing := _missing(PROGRAMS):
        return f"{missing} missing: apt-get install slurm-wlm munge"
    return "" if os.geteuid() == 0 else "slurmd and the jobs of others need root"


def why_no_accounts() -> str:
    """Why a cluster has no accounts here; empty if it has."""
    missing = _missing(ACCOUNTANTS)
    return missing and f"{missing} missing: apt-get install slurmdbd mariadb-server-core mariadb-client-core"


def _missing(programs: Iterable[str]) -> str:
    return ", ".join(name for name in programs if shutil.which(name, path=PATH) is None)


class SlurmCluster:
    """The cluster, as a user of it sees it who stands in the checkout."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {
            **{name: value for name, value in os.environ.items() if not name.startswith("SLURM_")},
            "PATH": PATH,
            "SLURM_CONF": str(folder / "slurm.conf"),
            "MYSQL_UNIX_PORT": str(folder / "mariadb.socket"),
            "SBATCH_OUTPUT": str(folder / "job-%j.out"),
            "PIPELINE_VENV": sys.prefix,
        }

    def start(self, *command: str) -> subprocess.Popen[bytes]:
        """Start a program of SLURM's, which dies with this process."""
        return subprocess.Popen(
            ["setpriv", "--pdeathsig", "KILL", *command],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=(self.folder / f"{command[0]}.stderr").open("ab"),
        )

    def processes(self) -> list[psutil.Process]:
        """Those of its daemons and jobs."""
        own = []
        for process in psutil.process_iter():
            with suppress(psutil.Error):
                if process.environ().get("SLURM_CONF") == self.environment["SLURM_CONF"]:
                    own.append(process)
        return own

    def run(self, *command: object, **environment: str) -> str:
        """What a command prints; it succeeds."""
        ended = subprocess.run(
            [*map(str, command)],
            cwd=PROJECT,
            env={**self.environment, **environment},
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        assert ended.returncode == 0, f"{command}\n{ended.stdout}\n{ended.stderr}"
        return ended.stdout.strip()

    def sbatch(self, *arguments: object, **environment: str) -> int:
        """Submit a job; its number."""
        return int(self.run("sbatch", "--parsable", *arguments, **environment))

    def states(self) -> dict[int, str]:
        """Of all jobs, by their numbers; each task of an array has one."""
        lines = self.run("squeue", "--states=all", "--array", "--noheader", "--format=%A %T").splitlines()
        return {int(number): state for number, state in map(str.split, lines)}

    def booked(self, jobs: Iterable[str]) -> list[str]:
        """`name|account|state` of each, in order; each task of an array has one."""
        options = ("--allocations", "--noheader", "--parsable2", "--format=JobName,Account,State")
        return sorted(self.run("sacct", *options, f"--jobs={','.join(jobs)}").splitlines())

    def active(self) -> set[int]:
        """The jobs that run or wait."""
        return {int(number) for number in self.run("squeue", "--array", "--noheader", "--format=%A").split()}

    def begun_on(self, node: str) -> set[int]:
        """The jobs that were started on a node, those that ended there too."""
        return {
            int(number)
            for number in self.run(
                "squeue", "--states=all", "--array", f"--nodelist={node}", "--noheader", "--format=%A"
            ).split()
        }

    @staticmethod
    def job_of(process: psutil.Process) -> str:
        """The job that a process belongs to, as `scancel` takes it: a task of an array by its place there.

        By the number that such a task also has, `scancel` ends the whole array (the last one's), or nothing.
        """
        seen = process.environ()
        task = seen.get("SLURM_ARRAY_TASK_ID")
        return f"{seen['SLURM_ARRAY_JOB_ID']}_{task}" if task else seen["SLURM_JOB_ID"]

    def node_of(self, job: int | str) -> str:
        """The node that a job runs on."""
        return self.run("squeue", f"--jobs={job}", "--noheader", "--format=%N")

    def restarts(self, job: str) -> int:
        """How many times SLURM took a job back to begin it again."""
        return int(self.run("scontrol", "show", "--oneliner", "job", job).partition(" Restarts=")[2].split()[0])

    def gpus_of(self, job: int) -> set[str]:
        """The GPUs that processes of a job see, by their numbers."""
        seen = [process.environ() for process in self.processes() if process.name() == "dask"]
        return {each["CUDA_VISIBLE_DEVICES"] for each in seen if each["SLURM_JOB_ID"] == str(job)}

    def set_node(self, node: str, state: str) -> None:
        """Drain a node, take it down, or resume it."""
        self.run("scontrol", "update", f"NodeName={node}", f"State={state}", "Reason=test")

    def printed(self) -> str:
        """What all jobs printed."""
        return "".join(f"--- {path.name}\n{path.read_text()}" for path in sorted(self.folder.glob("job-*.out")))

    def wait(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for it; when it never comes, say how the jobs stand and what they printed."""
        try:
            wait_until(condition, what)
        except AssertionError as error:
            raise AssertionError(f"{what}: {self.states()}\n{self.printed()}") from error

    def clear(self) -> None:
        """Cancel all jobs, and have every node back."""
        self.run("scancel", "--user=root")
        self.wait(lambda: not self.active(), "jobs do not end")
        self.wait(self._are_nodes_back, "nodes do not come back")
        for path in self.folder.glob("job-*.out"):
            path.unlink()

    def _are_nodes_back(self) -> bool:
        for node in NODES:
            if self.run("sinfo", f"--nodes={node}", "--noheader", "--format=%t") in ("drain", "down"):
                self.set_node(node, "resume")
        return self.is_idle()

    def is_idle(self) -> bool:
        """Whether all nodes are there and have nothing to do."""
        return set(self.run("sinfo", "--noheader", "--Node", "--format=%T").split()) == {"idle"}


def _is_served(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((HOST, port)) == 0


@contextmanager
def slurm_cluster(folder: Path) -> Iterator[SlurmCluster]:
    """A cluster whose nodes are idle; nothing of it lives on after the block."""
    cluster = SlurmCluster(folder)
    ports = [free_port() for _ in range(1 + len(NODES))]
    nodes = "\n".join(
        f"NodeName={name} NodeHostname=localhost NodeAddr={HOST} Port={port} {ROOM}"
        + (f" Gres=gpu:{len(DEVICES)}" if name == GPU_NODE else "")
        for name, port in zip(NODES, ports[1:], strict=True)
    )
    (folder / "slurm.conf").write_text(CONFIGURATION.format(folder=folder, port=ports[0], nodes=nodes))
    (folder / "gres.conf").write_text("".join(f"NodeName={GPU_NODE} Name=gpu File={file}\n" for file in DEVICES))
    (folder / "munge.key").write_bytes(os.urandom(128))
    (folder / "munge.key").chmod(0o400)
    (folder / "state").mkdir()
    files = [f"--{name}-file={folder}/munge.{name}" for name in ("key", "pid", "log", "seed")]
    with ExitStack() as daemons:
        daemons.callback(lambda: [process.kill() for process in cluster.processes()])

        def start(*command: str) -> None:
            daemons.enter_context(running(cluster.start(*command)))

        start("munged", "--foreground", "--force", f"--socket={folder}/munge.socket", *files)
        wait_until((folder / "munge.socket").exists, "munged never came up")
        if not why_no_accounts():
            port = free_port()
            with (folder / "slurm.conf").open("a") as configuration:
                configuration.write(ACCOUNTING.format(folder=folder, port=port))
            (folder / "slurmdbd.conf").write_text(DATABASE.format(folder=folder, port=port))
            (folder / "slurmdbd.conf").chmod(0o600)
            data = ("--no-defaults", "--user=root", f"--datadir={folder}/mariadb", "--innodb-log-file-size=8M")
            daemons.callback(shutil.rmtree, folder / "mariadb")  # a hundred megabytes
            cluster.run("mariadb-install-db", *data, "--skip-test-db")
            start("mariadbd", *data, f"--socket={folder}/mariadb.socket", "--skip-networking")
            wait_until((folder / "mariadb.socket").exists, "mariadbd never came up")
            start("slurmdbd", "-D")
            wait_until(lambda: _is_served(port), "slurmdbd never came up")
            accounts = f"account {FILMS}", f"account {SMALL} MaxSubmitJobs=3", f"user root account={FILMS},{SMALL}"
            for entity in ("cluster test", *accounts):
                cluster.run("sacctmgr", "--immediate", "add", *entity.split())
        start("slurmctld", "-D")
        for name in NODES:
            start("slurmd", "-D", "-N", name)
        cluster.wait(cluster.is_idle, "the nodes never came up")
        yield cluster
        cluster.clear()
