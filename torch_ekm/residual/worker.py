"""Work beside updates, in one thread: what it finds is taken at a sample that was fixed beforehand."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import torch

_pool: ThreadPoolExecutor | None = None


def start(job: Callable[[], None]) -> Future[None]:
    """Do it in the thread, after what was given before; torch takes as many threads for it as here."""
    global _pool
    if _pool is None:
        count = torch.get_num_threads()
        _pool = ThreadPoolExecutor(1, "torch_ekm", lambda: torch.set_num_threads(count))
    return _pool.submit(job)


def rest() -> None:
    """Wait until nothing is left to do, and end the thread; the next job starts another one."""
    global _pool
    if _pool is not None:
        _pool.shutdown(wait=True)
        _pool = None
