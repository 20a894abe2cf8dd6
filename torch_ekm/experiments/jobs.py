"""Run independent jobs in processes, with progress, and resume what was interrupted.

Processes are joblib's (loky): fresh ones, since a forked copy of PhysX or of a thread pool is not safe to
use, and they take lambdas and classes of a notebook.
"""

from __future__ import annotations

import itertools
import json
import os
import threading
import time
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
    whole or not at all, and is written here, wherever the job ran; it has the job's name in it, and one that
    is not what it should be is named in a warning, and the job run again. When a job fails, its exception has
    the job's name as a note, and what has not begun is cancelled, as it is when the caller stops asking.
    Processes end with this one, however it ends.

    Args:
        function: with results that JSON can hold.
        processes: 1 runs in this process. PhysX steps hold the interpreter's lock: threads do not help.
        on_done: called with the name of each job that is done, those of an earlier run first.

    Raises:
        WorkerDiedError: a process was killed; the same call goes on with what is missing.
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
                text = json.dumps({"job": name, "result": result}, sort_keys=True)
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


def _in_processes(
    processes: int, function: Callable[..., Any], jobs: Jobs
) -> Generator[tuple[str, Any], None, None]:
    n = min(processes, len(jobs))
    if n <= 1:
        for name, arguments in jobs.items():
            with _named(name):
                result = function(*arguments)
            yield name, result
        return
    loky = require("joblib.externals.loky")
    threads = str(max((os.cpu_count() or 1) // n, 1))
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    env = {name: os.environ.get(name, threads) for name in names}
    no_news = "ignore:a process in the background compiles loops"  # of a job
    env["PYTHONWARNINGS"] = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), no_news)))
    pool = loky.ProcessPoolExecutor(n, env=env, initializer=_end_with, initargs=(os.getpid(),))
    left, running = iter(jobs.items()), dict[Future, str]()
    try:
        while True:
            for name, arguments in itertools.islice(left, n - len(running)):  # others can be cancelled
                running[pool.submit(function, *arguments)] = name
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                name = running.pop(future)
                try:
                    with _named(name):
                        result = future.result()
                except loky.process_executor.TerminatedWorkerError:
                    raise WorkerDiedError from None
                yield name, result
    finally:
        pool.shutdown(kill_workers=True)


def _end_with(parent: int) -> None:
    """This process ends when its parent has: killed, a parent gives no notice."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def read_result(path: Path, name: str) -> Any:
    """Read what the job of this name left in a file of :func:`run_jobs`.

    Raises:
        ValueError: the file is not one that was written for this job.
    """
    try:
        kept = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        raise ValueError("no JSON, so no result of a job") from None
    if not isinstance(kept, dict) or "result" not in kept or "job" not in kept:
        raise ValueError("no result of a job")
    if kept["job"] != name:
        raise ValueError(f"the result of another job, {kept['job']!r}")
    return kept["result"]
