"""A cache of the values that were used last, as many as fit into so much memory."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class BoundedCache(Generic[K, V]):
    """A cache by key; each value is valid for one state of its source. Safe to share between threads.

    All values together have `most_bytes` by their sizes [bytes]; the one that came last is kept in any case.
    """

    def __init__(self, most_bytes: int, size_of: Callable[[V], int]) -> None:
        self._most_bytes, self._size_of = most_bytes, size_of
        self._kept: OrderedDict[K, tuple[Hashable, V]] = OrderedDict()
        self._lock = threading.Lock()
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: K, state: Hashable) -> V | None:
        """The value of a key, if it is of this state."""
        with self._lock:
            kept = self._kept.get(key)
            if kept is None or kept[0] != state:
                return None
            self._kept.move_to_end(key)
            return kept[1]

    def put(self, key: K, state: Hashable, value: V) -> None:
        """Keep a value instead of those that were not used for the longest time."""
        with self._lock:
            before = self._kept.pop(key, None)
            self.bytes += self._size_of(value) - (0 if before is None else self._size_of(before[1]))
            self._kept[key] = state, value
            while self.bytes > self._most_bytes and len(self._kept) > 1:
                self.bytes -= self._size_of(self._kept.popitem(last=False)[1][1])

    def clear(self) -> None:
        """Forget all values."""
        with self._lock:
            self._kept.clear()
            self.bytes = 0
