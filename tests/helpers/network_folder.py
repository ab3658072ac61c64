"""A folder shared by hosts over a network as NFS shares one without its lock daemon, made of FUSE and datagrams.

    network_folder.py serve ROOT ADDRESS
    network_folder.py mount ADDRESS MOUNT_POINT CACHE_S SOFT_S

What is opened shows the newest bytes, names and attributes are cached by each host for CACHE_S, and locks are the
host's own. A server that does not answer is asked again: for ever with a SOFT_S of 0 ("hard"), else until calls fail
with ETIMEDOUT. The server answers a repeated request without doing it again.
"""

import errno
import os
import pickle
import socket
import stat
import sys
import threading
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

PORT = 2049
MAX_DATAGRAM = 65_000
MAX_TRANSFER = 32_768
RETRY_S = 0.2
REMEMBERED_REPLIES = 4096
UTIME_NOW, UTIME_OMIT = 0x3FFFFFFF, 0x3FFFFFFE  # in place of a time's nanoseconds
ATTRIBUTES = ("st_mode", "st_ino", "st_nlink", "st_uid", "st_gid", "st_size", "st_blocks", "st_rdev")


class Server:
    """Does what clients ask for, one request after the other, below `root`."""

    def __init__(self, root: str) -> None:
        self._root = root

    def _at(self, path: str) -> Path:
        return Path(self._root + path)

    def getattr(self, path: str, fh: int | None = None) -> dict[str, int]:
        status = self._at(path).lstat() if fh is None else os.fstat(fh)
        times = {f"st_{name}": getattr(status, f"st_{name}_ns") for name in ("atime", "mtime", "ctime")}
        return {**{name: getattr(status, name) for name in ATTRIBUTES}, **times}

    def readdir(self, path: str, _fh: int) -> list[tuple[str, dict[str, int], int]]:
        kinds = {True: stat.S_IFDIR, False: 0}  # 0: unknown, who wants to know asks
        with os.scandir(self._at(path)) as entries:
            return [(entry.name, {"st_ino": entry.inode(), "st_mode": kinds[entry.is_dir()]}, 0) for entry in entries]

    def readlink(self, path: str) -> str:
        return str(self._at(path).readlink())

    def mkdir(self, path: str, mode: int) -> None:
        self._at(path).mkdir(mode)

    def unlink(self, path: str) -> None:
        self._at(path).unlink()

    def rmdir(self, path: str) -> None:
        self._at(path).rmdir()

    def symlink(self, name: str, target: str) -> None:
        self._at(name).symlink_to(target)

    def rename(self, old: str, new: str) -> None:
        self._at(old).rename(self._at(new))

    def link(self, new: str, old: str) -> None:
        self._at(new).hardlink_to(self._at(old))

    def chmod(self, path: str, mode: int) -> None:
        self._at(path).chmod(mode)

    def chown(self, path: str, user: int, group: int) -> None:
        os.chown(self._at(path), user, group)

    def truncate(self, path: str, length: int, fh: int | None = None) -> None:
        os.truncate(self._at(path) if fh is None else fh, length)

    def utimens(self, path: str, times: tuple[int, int]) -> None:
        status, now = self._at(path).lstat(), time.time_ns()
        present = (status.st_atime_ns, status.st_mtime_ns)
        named = {UTIME_NOW: (now, now), UTIME_OMIT: present}
        new = [named.get(time_ns, (time_ns, time_ns))[i] for i, time_ns in enumerate(times)]
        os.utime(self._at(path), ns=(new[0], new[1]), follow_symlinks=False)

    def create(self, path: str, mode: int, flags: int) -> int:
        return os.open(self._at(path), (flags | os.O_CREAT) & ~os.O_APPEND, mode)

    def open(self, path: str, flags: int) -> int:
        return os.open(self._at(path), flags & ~os.O_APPEND)

    def read(self, _path: str, size: int, offset: int, fh: int) -> bytes:
        return os.pread(fh, size, offset)

    def write(self, _path: str, data: bytes, offset: int, fh: int) -> int:
        return os.pwrite(fh, data, offset)

    def fsync(self, _path: str, _data_only: int, fh: int) -> None:
        os.fsync(fh)

    def release(self, _path: str, fh: int) -> None:
        os.close(fh)

    def statfs(self, path: str) -> dict[str, int]:
        status = os.statvfs(self._at(path))
        return {name: getattr(status, name) for name in dir(status) if name.startswith("f_") and name != "f_fsid"}


def serve(root: str, address: str) -> None:
    """Answer requests until killed."""
    server, replies = Server(root), OrderedDict[bytes, bytes]()
    os.umask(0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as door:
        door.bind((address, PORT))
        while True:
            request, client = door.recvfrom(MAX_DATAGRAM)
            number, operation, arguments = pickle.loads(request)
            if number not in replies:
                try:
                    answer = getattr(server, operation)(*arguments)
                except OSError as error:
                    answer = error
                replies[number] = pickle.dumps((number, answer))
                if len(replies) > REMEMBERED_REPLIES:
                    replies.popitem(last=False)
            try:
                door.sendto(replies[number], client)
            except OSError as error:
                if error.errno not in UNREACHABLE:
                    raise


UNREACHABLE = {errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ECONNREFUSED, errno.EAGAIN}


class Network(threading.local):
    """Requests to the server, from a socket of each thread's own."""

    def __init__(self, address: str, soft_s: float) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(RETRY_S)
        self._server = (address, PORT)
        self._soft_s = soft_s

    def ask(self, operation: str, *arguments: Any) -> Any:
        number, began = os.urandom(16), time.monotonic()
        request = pickle.dumps((number, operation, arguments))
        while True:
            try:
                self._socket.sendto(request, self._server)
                answered = b""
                while answered != number:
                    answered, answer = pickle.loads(self._socket.recv(MAX_DATAGRAM))
            except OSError as error:
                if self._soft_s and time.monotonic() - began > self._soft_s:
                    raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT)) from error
                if not isinstance(error, TimeoutError):
                    time.sleep(RETRY_S)
                continue
            if isinstance(answer, OSError):
                raise answer
            return answer


def mount(address: str, mount_point: str, cache_s: str, soft_s: str) -> None:
    """Mount the served folder, until killed."""
    os.environ["FUSE_LIBRARY_NAME"] = "fuse3"
    import mfusepy

    network = Network(address, float(soft_s))

    def asking(operation: str) -> Any:
        return lambda _self, *arguments: network.ask(operation, *arguments)

    def set_up(_self: Any, connection: Any, _settings: Any) -> None:
        connection.max_write = connection.max_read = MAX_TRANSFER

    names = [name for name in vars(Server) if not name.startswith("_")]
    # The library looks at the number of `create`'s arguments.
    own = {
        "create": lambda _self, path, mode, flags: network.ask("create", path, mode, flags),
        "init_with_config": set_up,
        "use_ns": True,  # times are whole nanoseconds
    }
    operations = type("NetworkFolder", (mfusepy.Operations,), {**{name: asking(name) for name in names}, **own})
    timeouts = dict.fromkeys(("attr_timeout", "entry_timeout", "negative_timeout"), cache_s)
    mfusepy.FUSE(
        operations(),
        mount_point,
        foreground=True,
        subtype="network-folder",  # the kind of file system is then "fuse.network-folder"
        direct_io=True,  # reads are of the server's bytes, whatever size is cached
        use_ino=True,
        max_read=MAX_TRANSFER,
        **timeouts,
    )


if __name__ == "__main__":
    {"serve": serve, "mount": mount}[sys.argv[1]](*sys.argv[2:])
