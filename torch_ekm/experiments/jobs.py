"""Run independent jobs in processes, with progress, and resume what was interrupted.

Processes are joblib's (loky): fresh ones, since a forked copy of PhysX or of a thread pool is not safe to
use, and they take lambdas and classes of a notebook. Each has a pool of its own, so that it is known which
job a process died of.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from .._extras import require
from .._files import WriterLock, make_folder, write_whole
from .._warnings import warn
from ..exceptions import WorkerDiedError
from ..residual import warm_up

Jobs = Mapping[str, tuple[Any, ...]]
Outcomes = Generator[tuple[str, Any], None, None]

_TRIES = 3  # of a job whose process dies
_WATCH = 0.25  # [s] between a process's looks at whether its parent lives


def run_jobs(
    function: Callable[..., Any],
    jobs: Jobs,
    folder: Path,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """``{name: function(*arguments)}`` for all jobs, each result kept in ``folder/name.json``.

    A job whose file exists is not run again, so an interrupted run continues where it stopped. A file appears
    whole or not at all, and is written here, wherever the job ran; it has the job's name and a digest in it,
    and one that is not what it should be is named in a warning, and the job run again. When a job fails, its
    exception has the job's name as a note, and what has not begun is cancelled, as it is when the caller
    stops asking. A job whose process is killed is run again, three times at most; processes end with this
    one, however it ends.

    Args:
        function: with results that JSON can hold.
        processes: 1 runs in this process. PhysX steps hold the interpreter's lock: threads do not help.
        on_done: called with the name of each job that is done, those of an earlier run first.

    Raises:
        WorkerDiedError: a job's process was killed each time it was tried; the message names the job.
        FolderInUseError: another process runs jobs into this folder; the message names the process.
        OutputError: a result cannot be written.
        MissingExtraError: joblib is not installed.
    """
    results, report = {}, on_done or (lambda name: None)
    make_folder(folder)
    with WriterLock(folder):
        for name in jobs:
            path = folder / f"{name}.json"
            if path.exists():
                try:
                    results[name] = read_result(path, name)
                except ValueError as error:
                    warn(f"{path}: {error}; the job is run again")
        for name in results:
            report(name)
        waiting = {name: arguments for name, arguments in jobs.items() if name not in results}
        if waiting:
            warm_up()  # else results would depend, by rounding, on when the loops are compiled
        with closing(_in_processes(processes, function, waiting)) as outcomes:
            for name, result in outcomes:
                text = _text(name, result)
                write_whole(folder / f"{name}.json", text)
                results[name] = json.loads(text)["result"]  # in the types that a resumed run reads
                report(name)
    return {name: results[name] for name in jobs}


@contextmanager
def _named(job: str) -> Iterator[None]:
    """Errors that are raised here say in which job."""
    try:
        yield
    except Exception as error:
        error.add_note(f"in the job '{job}'")
        raise


def _in_processes(processes: int, function: Callable[..., Any], jobs: Jobs) -> Outcomes:
    if min(processes, len(jobs)) <= 1:
        for name, arguments in jobs.items():
            with _named(name):
                result = function(*arguments)
            yield name, result
        return
    loky = require("joblib.externals.loky")
    died = require("joblib.externals.loky.process_executor").TerminatedWorkerError
    n = min(processes, len(jobs))
    threads = str(max((os.cpu_count() or 1) // n, 1))
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    env = {name: os.environ.get(name, threads) for name in names}

    def new() -> Any:
        return loky.ProcessPoolExecutor(1, env=env, initializer=_watching(os.getpid()))

    pools, idle = [new() for _ in range(n)], list(range(n))
    waiting = deque((name, 1) for name in jobs)
    running: dict[Future, tuple[int, str, int]] = {}
    try:
        while waiting or running:
            while idle and waiting:
                place, (name, tries) = idle.pop(), waiting.popleft()
                running[pools[place].submit(function, *jobs[name])] = place, name, tries
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                place, name, tries = running.pop(future)
                idle.append(place)
                try:
                    with _named(name):
                        result = future.result()
                except died:
                    if tries == _TRIES:
                        raise WorkerDiedError(name, tries) from None
                    pools[place].shutdown(kill_workers=True)
                    pools[place] = new()
                    waiting.appendleft((name, tries + 1))
                    continue
                yield name, result
    finally:
        for pool in pools:
            pool.shutdown(wait=False, kill_workers=True)
        for pool in pools:
            pool.shutdown(kill_workers=True)


def _watching(parent: int) -> Callable[[], None]:
    """Ends a process when its parent has: killed, a parent gives no notice.

    A local function goes to the process by value, which so imports what its jobs need and no more. What is
    compiled in the background is no news of a job.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH)
        os._exit(1)

    def begin() -> None:
        warnings.filterwarnings("ignore", "a process in the background compiles loops")
        if os.name != "nt":  # there a process keeps the number of a parent that is gone
            threading.Thread(target=watch, daemon=True).start()

    return begin


def read_result(path: Path, name: str) -> Any:
    """Read what the job of this name left in a file of :func:`run_jobs`.

    Raises:
        ValueError: the file is not, byte by byte, one that was written for this job.
    """
    content = path.read_bytes()
    try:
        kept = json.loads(content)
    except (ValueError, RecursionError):
        raise ValueError("no JSON, so no result of a job") from None
    if not isinstance(kept, dict) or "result" not in kept or "job" not in kept:
        raise ValueError("no result of a job")
    if kept["job"] != name:
        raise ValueError(f"the result of another job, {kept['job']!r}")
    if _text(name, kept["result"]).encode() != content:
        raise ValueError("damaged: its digest (SHA-256) is another")
    return kept["result"]


def _text(name: str, result: Any) -> str:
    digest = hashlib.sha256(json.dumps([name, result], sort_keys=True).encode()).hexdigest()
    return json.dumps({"job": name, "result": result, "sha256": digest}, sort_keys=True)
