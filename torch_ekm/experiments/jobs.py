"""Run independent jobs in processes or on a cluster, with progress, and resume what was interrupted."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from .clusters import cluster_outcomes


def run_jobs(
    function: Callable[..., Any],
    jobs: dict[str, tuple[Any, ...]],
    folder: Path,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
    address: str | None = None,
) -> dict[str, Any]:
    """``{name: function(*arguments)}`` for all jobs, each result kept in ``folder/name.json``.

    A job whose file exists is not run again, so an interrupted run goes on where it stopped. A file
    appears whole or not at all.

    Args:
        function: importable, with results that JSON can hold.
        jobs: name -> arguments.
        processes: 1 runs in this process. PhysX steps hold the interpreter's lock: threads do not help.
        on_done: called with the name of each job that is done, those of an earlier run first.
        address: of a cluster that does the work instead of processes here, see
            :func:`~torch_ekm.experiments.clusters.cluster_outcomes`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    results = {name: read for name in jobs if (read := _read(folder / f"{name}.json")) is not None}
    for name in results:
        _tell(on_done, name)
    waiting = [name for name in jobs if name not in results]
    for name, result in _outcomes(function, jobs, waiting, processes, address):
        _write(folder / f"{name}.json", result)
        results[name] = json.loads(json.dumps(result))  # the same types as after a resume
        _tell(on_done, name)
    return {name: results[name] for name in jobs}


def _outcomes(
    function: Callable[..., Any],
    jobs: dict[str, tuple[Any, ...]],
    waiting: list[str],
    processes: int,
    address: str | None,
) -> Iterable[tuple[str, Any]]:
    if address is not None:
        yield from cluster_outcomes(address, function, {name: jobs[name] for name in waiting})
        return
    if processes <= 1 or len(waiting) <= 1:
        for name in waiting:
            yield name, function(*jobs[name])
        return
    # spawn: a forked copy of PhysX or of a thread pool is not safe to use
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        futures = {pool.submit(function, *jobs[name]): name for name in waiting}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            for future in futures:
                future.cancel()
            raise


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return None


def _write(path: Path, result: Any) -> None:
    part = path.with_suffix(".part")
    part.write_text(json.dumps(result), encoding="utf-8")
    os.replace(part, path)


def _tell(on_done: Callable[[str], None] | None, name: str) -> None:
    if on_done is not None:
        on_done(name)
