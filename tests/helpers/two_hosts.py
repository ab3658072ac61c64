"""Two machines as far as programs can see, and a folder that they share over a network; needs root, on Linux.

Each host is a set of namespaces: processes, mounts, name, network, and a boot of its own. A cable leads from each to
the namespace of the server. The folder has the same path everywhere; outside the hosts it is the server's own.
"""

import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from ctypes.util import find_library
from pathlib import Path
from shutil import which

import psutil
from farm_processes import HERE, PATIENCE_S, Farm, wait_until

CLOCK_ERROR_S = 300.0
"""One host's clock is wrong by so much, the other's the other way."""
CACHE_S = 3.0
"""How long hosts believe what they know of names and attributes."""
_INIT = "import signal; signal.signal(signal.SIGCHLD, signal.SIG_IGN)\nwhile True: signal.pause()"
"""The first process of a host: it reaps those that lost their parents."""


def what_is_missing() -> str:
    """Why there can be no two hosts here; empty if there can."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "namespaces and mounts are root's, on Linux"
    missing = [tool for tool in ("ip", "nsenter", "unshare") if which(tool) is None]
    missing += [path for path in ("/dev/fuse",) if not os.access(path, os.R_OK | os.W_OK)]
    missing += [] if find_library("fuse3") else ["libfuse3 (apt-get install fuse3)"]
    if missing:
        return f"there is no {', '.join(missing)}"
    tried = subprocess.run(
        ["unshare", "--net", "--uts", "--mount", "--pid", "--fork", "true"], capture_output=True, check=False
    )
    return tried.stderr.decode().strip()


def _unshared(*kinds: str) -> tuple[subprocess.Popen[bytes], psutil.Process]:
    """A process that sleeps in namespaces of these kinds, below one that ends it with itself."""
    outer = subprocess.Popen(
        ["unshare", *kinds, "--fork", "--kill-child", sys.executable, "-S", "-c", _INIT], stderr=subprocess.DEVNULL
    )
    wait_until(lambda: _ignores_children(psutil.Process(outer.pid).children()), "the namespaces are there")
    return outer, psutil.Process(outer.pid).children()[0]


def _ignores_children(processes: list[psutil.Process]) -> bool:
    """Whether it has come to what it does."""
    return any(
        int(line.split()[1], 16) >> (signal.SIGCHLD - 1) & 1
        for process in processes
        for line in Path(f"/proc/{process.pid}/status").read_text().splitlines()
        if line.startswith("SigIgn:")
    )


class Host(Farm):
    """A machine in whose shared folder a farm lies."""

    def __init__(self, name: str, folder: Path, own: Path, *, expiry_s: float | None) -> None:
        super().__init__(folder)
        own.mkdir()
        self.name = name
        self._own = own
        self._outer, init = _unshared("--net", "--uts", "--mount", "--pid", "--mount-proc")
        self.pid = init.pid
        self.environment = {
            "PYTHONPATH": os.pathsep.join([*map(str, (HERE.parent / "campaign/hooks", HERE, HERE.parents[1]))]),
            "CAMPAIGN_CONTROL": str(own),
            **({} if expiry_s is None else {"LEASE_EXPIRY_S": str(expiry_s)}),
        }
        boot = own / "boot_id"
        boot.write_text(f"{uuid.uuid4()}\n")
        self.do("hostname", name)
        self.do("mount", "--bind", str(boot), "/proc/sys/kernel/random/boot_id")
        self.do("ip", "link", "set", "lo", "up")

    def command(self, *words: str) -> list[str]:
        """A command line that runs another one on this host."""
        variables = [f"{name}={value}" for name, value in self.environment.items()]
        inside = ["nsenter", "--target", str(self.pid), "--net", "--uts", "--mount", "--pid"]
        return [*inside, "env", "-C", str(self.folder), *variables, *words]

    def do(self, *words: str) -> None:
        subprocess.run(self.command(*words), check=True, timeout=PATIENCE_S)

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        return self.start_program(str(HERE / "synthetic_command.py"), *arguments)

    def start_program(self, *words: str) -> subprocess.Popen[str]:
        """Start a Python program."""
        process = subprocess.Popen(
            self.command(sys.executable, *words),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self._started.append(process)
        return process

    def set_clock(self, error_s: float) -> None:
        (self._own / "clock").write_text(str(error_s))

    def stop_at(self, pattern: str) -> None:
        """Let the next process that is about to do what matches stop (SIGSTOP); see the campaign's hooks."""
        (self._own / "failpoint").write_text(f"other {int(signal.SIGSTOP)} {pattern}")

    def stands(self) -> bool:
        """Whether one has stopped so."""
        return (self._own / "failpoint.hit").exists()

    def commits(self) -> list[str]:
        """Receipts that its processes have put in place, or were about to, by path below their folder."""
        path = self._own / "commits"
        return path.read_text().split() if path.exists() else []

    def lose_power(self) -> None:
        """All its processes end at once, and its mount with them."""
        psutil.Process(self.pid).kill()
        self._outer.wait(timeout=PATIENCE_S)

    def close(self) -> None:
        if self._outer.poll() is None:
            self.lose_power()
        for process in self._started:
            process.communicate(timeout=PATIENCE_S)


class Network:
    """The server's namespace, where cables end."""

    def __init__(self, folder: Path, soft_s: float) -> None:
        self._folder = folder
        self._soft_s = soft_s
        self._outer, server = _unshared("--net")
        self._pid = server.pid
        self._serving = subprocess.Popen(self._inside(*_network_folder("serve", str(folder), "0.0.0.0")))
        self._mounts: list[subprocess.Popen[bytes]] = []

    def _inside(self, *words: str) -> list[str]:
        return ["nsenter", "--target", str(self._pid), "--net", *words]

    def plug(self, host: Host, number: int) -> None:
        """Connect a host, and mount the folder on it."""
        cable = f"cable{number}"
        ours, theirs = (f"192.0.2.{4 * number + i}" for i in (1, 2))
        self._ip("link", "add", cable, "type", "veth", "peer", "name", "eth0", "netns", str(host.pid))
        self._ip("address", "add", f"{ours}/30", "dev", cable)
        self._ip("link", "set", cable, "up")
        host.do("ip", "address", "add", f"{theirs}/30", "dev", "eth0")
        host.do("ip", "link", "set", "eth0", "up")
        mounting = _network_folder("mount", ours, str(self._folder), str(CACHE_S), str(self._soft_s))
        self._mounts.append(subprocess.Popen(host.command(*mounting)))
        mounts = Path(f"/proc/{host.pid}/mounts")
        wait_until(lambda: f" {self._folder} fuse.network-folder" in mounts.read_text(), "the folder is mounted")

    def cut_for(self, number: int, seconds: float) -> None:
        """Let nothing through to or from a host for a while."""
        self._ip("link", "set", f"cable{number}", "down")
        time.sleep(seconds)
        self._ip("link", "set", f"cable{number}", "up")

    def _ip(self, *words: str) -> None:
        subprocess.run(self._inside("ip", *words), check=True, timeout=PATIENCE_S)

    def close(self) -> None:
        for process in (*self._mounts, self._serving, self._outer):
            process.kill()
            process.wait(timeout=PATIENCE_S)


def _network_folder(*words: str) -> list[str]:
    return [sys.executable, str(HERE / "network_folder.py"), *words]


@contextmanager
def two_hosts(
    place: Path, *, expiry_s: float | None = None, soft_s: float = 0.0
) -> Iterator[tuple[Network, Host, Host]]:
    """Hosts 0 and 1, with clocks ten minutes apart.

    `expiry_s` is after how long a host that is not heard of counts as dead; None: as usual. With `soft_s` calls to a
    server that does not answer fail after so long; else they wait.
    """
    folder = place / "shared"
    folder.mkdir()
    with ExitStack() as stack:
        network = Network(folder, soft_s)
        stack.callback(network.close)
        hosts = []
        for number, name in enumerate(("ash", "birch")):
            host = Host(name, folder, place / name, expiry_s=expiry_s)
            stack.callback(host.close)
            host.set_clock(CLOCK_ERROR_S * (1 - 2 * number))
            network.plug(host, number)
            hosts.append(host)
        yield network, hosts[0], hosts[1]
