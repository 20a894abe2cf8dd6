"""Run independent jobs in processes or on a cluster, with progress, and resume what was interrupted.

Processes are joblib's (loky): fresh ones, since a forked copy of PhysX or of a thread pool is not safe to
use, and they take lambdas and classes of a notebook. A cluster is asked directly, because joblib's Dask
backend waits for ever when a worker dies.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from .._extras import require
from ..exceptions import ParameterError

Jobs = Mapping[str, tuple[Any, ...]]
Outcomes = Generator[tuple[str, Any], None, None]

_PATIENCE = 10.0  # [s] for a scheduler to answer
_one_at_a_time = threading.Lock()


def run_jobs(
    function: Callable[..., Any],
    jobs: Jobs,
    folder: Path,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
    address: str | None = None,
) -> dict[str, Any]:
    """``{name: function(*arguments)}`` for all jobs, each result kept in ``folder/name.json``.

    A job whose file exists is not run again, so an interrupted run goes on where it stopped. A file appears
    whole or not at all, and is written here, wherever the job ran. When a job fails, or the caller stops
    asking, what has not begun is cancelled.

    Args:
        function: with results that JSON can hold; on a cluster, importable there.
        processes: 1 runs in this process. PhysX steps hold the interpreter's lock: threads do not help.
        on_done: called with the name of each job that is done, those of an earlier run first.
        address: ``dask://HOST:PORT`` of a scheduler whose cluster does the work instead of processes here.
            torch_ekm must be installed on its workers, with the same versions, and files that the arguments
            name must be found there under the same paths.

    Raises:
        ParameterError: ``address`` is no such address, or nobody answers there.
        MissingExtraError: joblib, or distributed, is not installed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    tell = on_done or (lambda name: None)
    results = {name: read for name in jobs if (read := _read(folder / f"{name}.json")) is not None}
    for name in results:
        tell(name)
    waiting = {name: arguments for name, arguments in jobs.items() if name not in results}
    # either gives (name, result) in the order in which the jobs end
    run = partial(_in_processes, processes) if address is None else partial(_on_dask, address)
    with closing(run(function, waiting)) as outcomes:
        for name, result in outcomes:
            results[name] = _write(folder / f"{name}.json", result)
            tell(name)
    return {name: results[name] for name in jobs}


def _in_processes(processes: int, function: Callable[..., Any], jobs: Jobs) -> Outcomes:
    joblib, processes = require("joblib"), max(min(processes, len(jobs)), 1)
    run = joblib.Parallel(
        processes, backend="loky", return_as="generator_unordered", batch_size=1, max_nbytes=None
    )
    try:
        with closing(run(joblib.delayed(_named)(name, function, job) for name, job in jobs.items())) as done:
            yield from done
    finally:
        if processes > 1:  # idle workers would keep what they have imported: SAPIEN, code edited since
            require("joblib.externals.loky").get_reusable_executor(reuse=True).shutdown(kill_workers=True)


def _on_dask(address: str, function: Callable[..., Any], jobs: Jobs) -> Outcomes:
    scheme, _, place = address.partition("://")
    if scheme != "dask" or not place:
        raise ParameterError("address", address, "dask://HOST:PORT")
    distributed = require("distributed")
    try:
        client = distributed.Client(f"tcp://{place}", timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ParameterError("address", address, f"a scheduler that answers ({error})") from error
    with client:  # its end cancels what has not begun
        # pure=False: a name is what a job is known by, not a hash of its arguments
        futures = {client.submit(_alone, function, job, pure=False): name for name, job in jobs.items()}
        for future in distributed.as_completed(futures, loop=client.loop):
            yield futures[future], future.result()


def _named(name: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[str, Any]:
    return name, function(*arguments)


def _alone(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """One at a time in this process: a cluster's worker may have several threads, and two simulations or two
    settings of torch's threads in one process get into each other's way."""
    with _one_at_a_time:
        return function(*arguments)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return None


def _write(path: Path, result: Any) -> Any:
    """``result`` in the types that a resumed run reads."""
    part, text = path.with_suffix(".part"), json.dumps(result)
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
    return json.loads(text)
