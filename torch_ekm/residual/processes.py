"""Learners in other processes: copies, with locks that nobody holds."""

from __future__ import annotations

import os
import pickle
import threading
import weakref
from typing import Any

import torch

_alive: weakref.WeakSet[Any] = weakref.WeakSet()
_held: list[Any] = []
_PATIENCE = 5.0  # for an update under way [s]


def track(learner: Any) -> None:
    """A fork waits for updates of this learner, and gives it a new lock in the child."""
    _alive.add(learner)


def unpickled(kind: Any, state: bytes) -> Any:
    """A learner of that kind and state, in memory of its own."""
    made = kind.__new__(kind)
    made.__setstate__(pickle.loads(state))
    return made


def _before_fork() -> None:
    """No update is under way: a child has only the thread that forked, so it would stay half done there."""
    _held.extend(learner for learner in list(_alive) if learner.lock.acquire(timeout=_PATIENCE))


def _in_parent() -> None:
    while _held:
        _held.pop().lock.release()


def _in_child() -> None:
    _held.clear()
    for learner in _alive:
        learner.lock = threading.RLock()
    if len(_alive):  # torch's own threads do not exist here
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_in_parent, after_in_child=_in_child)
