"""`Turns`: many threads may use an object at a time, or one alone may change it. A conflict raises
at once: waiting would hide a race in the caller's program.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


class Turns:
    """Tracks which threads use an object now, and which changes it. One thread may do both."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users: Counter[int] = Counter()  # open `using` blocks by thread
        self._changer: int | None = None

    @contextmanager
    def using(self, context: str) -> Iterator[None]:
        """Lets the block read; raises RuntimeError while another thread changes the object."""
        thread = threading.get_ident()
        with self._lock:
            if self._changer not in (None, thread):
                raise RuntimeError(f"{context}: another thread changes this tree")
            self._users[thread] += 1
        try:
            yield
        finally:
            with self._lock:
                self._users[thread] -= 1
                if not self._users[thread]:
                    del self._users[thread]

    @contextmanager
    def changing(self, context: str) -> Iterator[None]:
        """Lets the block write; raises RuntimeError while another thread uses or changes it."""
        thread = threading.get_ident()
        with self._lock:
            previous = self._changer
            if previous not in (None, thread):
                raise RuntimeError(f"{context}: another thread changes this tree")
            if set(self._users) - {thread}:
                raise RuntimeError(f"{context}: another thread renders or reads this tree")
            self._changer = thread
        try:
            yield
        finally:
            with self._lock:
                self._changer = previous

    def __reduce__(self) -> tuple[type[Turns], tuple[()]]:
        return Turns, ()  # a copy has no users yet
