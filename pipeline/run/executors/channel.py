"""Messages between the supervisor and a worker: pickles with a length in front, over a socket.

The supervisor's side never blocks, whatever the worker does: one that is stopped, or dies in the middle of a message,
costs nothing but its own message. (`multiprocessing.Connection.recv` waits for the rest of a message once it began.)
"""

import pickle
import socket
import struct
import threading
from typing import Any

_HEADER = struct.Struct(">Q")
_CHUNK = 1 << 16


def _frame(message: object) -> bytes:
    body = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return _HEADER.pack(len(body)) + body


def _load(body: bytes | bytearray) -> Any:
    return pickle.loads(body)  # noqa: S301 - from a process of our own, over a socket pair that nobody else can open


class Channel:
    """The supervisor's end."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self._incoming = bytearray()
        self._outgoing = bytearray()
        self.at_end = False
        """The other side is gone; no further message will come."""

    def fileno(self) -> int:
        """For selectors."""
        return self._socket.fileno()

    @property
    def has_unsent(self) -> bool:
        """Whether `flush` should be called when the socket takes data again."""
        return bool(self._outgoing)

    def send(self, message: object) -> None:
        """Send as much as the socket takes now, and keep the rest for `flush`."""
        self._outgoing += _frame(message)
        self.flush()

    def flush(self) -> None:
        """Send what is left, as far as the socket takes it."""
        try:
            while self._outgoing:
                del self._outgoing[: self._socket.send(self._outgoing)]
        except BlockingIOError:
            return
        except (BrokenPipeError, ConnectionResetError):
            self._outgoing.clear()
            self.at_end = True

    def receive(self) -> list[Any]:
        """All messages that have arrived completely."""
        try:
            while chunk := self._socket.recv(_CHUNK):
                self._incoming += chunk
            self.at_end = True
        except BlockingIOError:
            pass
        except ConnectionResetError:
            self.at_end = True
        messages = []
        position = 0
        while len(self._incoming) - position >= _HEADER.size:
            (length,) = _HEADER.unpack_from(self._incoming, position)
            end = position + _HEADER.size + length
            if len(self._incoming) < end:
                break
            messages.append(_load(self._incoming[position + _HEADER.size : end]))
            position = end
        del self._incoming[:position]
        return messages

    def close(self) -> None:
        """Close this end; the worker sees the end of its stream. May be called twice."""
        self._socket.close()

    @property
    def closed(self) -> bool:
        """Whether this end is closed."""
        return self._socket.fileno() < 0


class WorkerChannel:
    """The worker's end: plain blocking calls, safe to send on from several threads."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(True)
        self._socket = end
        self._sending = threading.Lock()

    def send(self, message: object) -> None:
        """Send a message."""
        data = _frame(message)
        with self._sending:
            self._socket.sendall(data)

    def receive(self) -> Any:
        """The next message. Raises EOFError when the supervisor is gone."""
        (length,) = _HEADER.unpack(self._read(_HEADER.size))
        return _load(self._read(length))

    def _read(self, size: int) -> bytearray:
        data = bytearray()
        while len(data) < size:
            chunk = self._socket.recv(min(_CHUNK, size - len(data)))
            if not chunk:
                raise EOFError("the supervisor closed its end")
            data += chunk
        return data
