"""Run jobs on a Dask or Ray cluster that is already there."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from .._extras import require
from ..exceptions import ParameterError

Jobs = Mapping[str, tuple[Any, ...]]

_PATIENCE = 10.0  # [s] for a scheduler to answer
_one_at_a_time = threading.Lock()


def cluster_outcomes(address: str, function: Callable[..., Any], jobs: Jobs) -> Iterator[tuple[str, Any]]:
    """``(name, function(*arguments))`` of each job, in the order in which they end.

    Results come back here: nothing is written on the cluster. torch_ekm must be installed on its
    workers, with the same versions, and files that the arguments name must be found there under the
    same paths. When a job fails, or the caller stops asking, what has not begun is cancelled.

    Args:
        address: ``dask://HOST:PORT`` of a Dask scheduler, ``ray://HOST:PORT`` of a Ray head's client
            server, or ``ray://auto`` on a machine that belongs to the Ray cluster.
        function: importable on the workers.

    Raises:
        ParameterError: not such an address, or nobody answers there.
        MissingExtraError: the cluster's package is not installed.
    """
    scheme, separator, place = address.partition("://")
    outcomes = {"dask": _on_dask, "ray": _on_ray}.get(scheme)
    if outcomes is None or not separator or not place:
        raise ParameterError("address", address, "dask://HOST:PORT, ray://HOST:PORT or ray://auto")
    return outcomes(place, function, jobs)


def alone(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """``function(*arguments)``, one at a time in this process: a worker may have several threads, and
    two simulations or two settings of torch's threads in one process get into each other's way."""
    with _one_at_a_time:
        return function(*arguments)


def _on_dask(place: str, function: Callable[..., Any], jobs: Jobs) -> Iterator[tuple[str, Any]]:
    distributed = require("distributed")
    try:
        client = distributed.Client(f"tcp://{place}", timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise _silent("dask", place, error) from error
    with client:
        # pure=False: a name is what a job is known by, not a hash of its arguments
        futures = {client.submit(alone, function, job, pure=False): name for name, job in jobs.items()}
        try:
            for future in distributed.as_completed(futures, loop=client.loop):
                yield futures[future], future.result()
        finally:
            client.cancel([future for future in futures if not future.done()])


def _on_ray(place: str, function: Callable[..., Any], jobs: Jobs) -> Iterator[tuple[str, Any]]:
    ray = require("ray")
    mine = not ray.is_initialized()
    if mine:
        try:
            ray.init("auto" if place == "auto" else f"ray://{place}", log_to_driver=False)
        except (ConnectionError, ValueError) as error:
            # a head that wants a token lets clients without one wait until they give up
            hint = f"{error}; a recent Ray wants RAY_AUTH_MODE=token and the head's token on both sides"
            raise _silent("ray", place, hint) from error
    try:
        run = ray.remote(num_cpus=1, max_retries=0)(alone)
        waiting = {run.remote(function, job): name for name, job in jobs.items()}
        try:
            while waiting:
                done, _ = ray.wait(list(waiting), num_returns=1)
                try:
                    result = ray.get(done[0])
                except ray.exceptions.RayTaskError as error:
                    raise error.cause from error  # the job's own error, as everywhere else
                yield waiting.pop(done[0]), result
        finally:
            for task in waiting:
                ray.cancel(task)
    finally:
        if mine:
            ray.shutdown()


def _silent(scheme: str, place: str, reason: object) -> ParameterError:
    return ParameterError("address", f"{scheme}://{place}", f"a cluster that answers ({reason})")
