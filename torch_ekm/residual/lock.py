"""One update at a time."""

from __future__ import annotations

import threading
from typing import Any


class UpdateLock:
    """A lock that one thread holds while it updates; a thread that holds it may take it again.

    A copy of a learner has a lock of its own, and a pickled one has a new one.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> UpdateLock:
        self._lock.acquire()
        return self

    def __exit__(self, *exception: object) -> None:
        self._lock.release()

    def __deepcopy__(self, memo: dict) -> UpdateLock:
        return UpdateLock()

    def __reduce__(self) -> tuple[Any, ...]:
        return UpdateLock, ()
