"""`HostCache`: arrays that were read, kept in host memory within a number of bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import numpy as np

Key = tuple[Any, ...]
Found = np.ndarray | str  # an array, or why it can't be read
Read = Callable[[list[Key]], dict[Key, Found]]


class HostCache:
    """Arrays by key; beyond a number of bytes the least recently used are dropped. What several
    threads ask for at once is read by one of them.

    Attributes:
        limit: Most bytes kept.
        nbytes: Bytes kept now.
    """

    def __init__(self, limit: int) -> None:
        """Keeps nothing yet."""
        self.limit, self.nbytes = limit, 0
        self._kept: OrderedDict[Key, np.ndarray] = OrderedDict()
        self._reading: dict[Key, Future[Found]] = {}
        self._lock = threading.Lock()

    def get(self, keys: Sequence[Key], read: Read) -> list[Found]:
        """Returns for each key an array, or a text that says why there is none.

        Args:
            keys: Each once.
            read: Called with the keys that are neither kept nor being read; texts are not kept.
        """
        found: dict[Key, Found] = {}
        mine: list[Key] = []
        others: dict[Key, Future[Found]] = {}
        with self._lock:
            for key in keys:
                if key in self._kept:
                    self._kept.move_to_end(key)
                    found[key] = self._kept[key]
                elif key in self._reading:
                    others[key] = self._reading[key]
                else:
                    mine.append(key)
                    self._reading[key] = Future()
        if mine:
            found.update(self._read(mine, read))
        for key, future in others.items():
            found[key] = future.result()
        return [found[key] for key in keys]

    def _read(self, mine: list[Key], read: Read) -> dict[Key, Found]:
        arrived: dict[Key, Found] = {}
        try:
            arrived = read(mine)
        finally:
            with self._lock:
                for key in mine:
                    value = arrived.get(key, "the read was broken off")
                    self._reading.pop(key).set_result(value)
                    if isinstance(value, np.ndarray) and value.nbytes <= self.limit:
                        self._kept[key] = value
                        self.nbytes += value.nbytes
                while self.nbytes > self.limit:
                    _, dropped = self._kept.popitem(last=False)
                    self.nbytes -= dropped.nbytes
        return arrived
