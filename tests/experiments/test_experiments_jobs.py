"""Jobs: parallel equals serial, an interrupted run resumes, and a cluster may do the work."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from operator import truediv
from pathlib import Path

import pytest

from torch_ekm.exceptions import MissingExtraError, ParameterError
from torch_ekm.experiments import clusters
from torch_ekm.experiments.jobs import run_jobs


def square(x: int) -> dict[str, float]:
    if x < 0:
        raise ValueError("negative")
    return {"x": x, "square": x**2}


def test_parallel_equals_serial(tmp_path: Path) -> None:
    jobs = {f"job_{x}": (x,) for x in range(4)}
    serial = run_jobs(square, jobs, tmp_path / "serial")
    parallel = run_jobs(square, jobs, tmp_path / "parallel", processes=2)
    assert serial == parallel
    assert list(serial) == list(jobs)
    assert serial["job_3"] == {"x": 3, "square": 9}


def test_interrupted_run_resumes(tmp_path: Path) -> None:
    done: list[str] = []
    with pytest.raises(ValueError, match="negative"):
        run_jobs(square, {"a": (1,), "b": (-1,), "c": (2,)}, tmp_path, on_done=done.append)
    assert done == ["a"]
    calls: list[int] = []

    def counted(x: int) -> dict[str, float]:
        calls.append(x)
        return square(x)

    (tmp_path / "c.json").write_text('{"x": 2, "squ')  # killed while writing, by something less careful
    result = run_jobs(counted, {"a": (1,), "b": (3,), "c": (2,)}, tmp_path)
    assert calls == [3, 2]
    assert result["b"]["square"] == 9


# -- clusters ----------------------------------------------------------------------------------------

DIVISIONS = {"a": (6, 3), "b": (1, 4), "c": (0, 2)}


def running_together(seconds: float) -> dict[str, int]:
    global running
    running += 1
    most = running
    time.sleep(seconds)
    running -= 1
    return {"most": most}


running = 0


@pytest.fixture(scope="module")
def dask_address() -> Iterator[str]:
    """A Dask cluster in this process: one worker of three threads."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=3, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        yield cluster.scheduler_address.replace("tcp://", "dask://")


def check_cluster(address: str, folder: Path) -> None:
    """Results come back and are written here; a failure is the job's own and leaves what is done."""
    done: list[str] = []
    (folder / "a.json").write_text("-1.0")  # from an earlier run
    results = run_jobs(truediv, DIVISIONS, folder, on_done=done.append, address=address)
    assert results == {"a": -1.0, "b": 0.25, "c": 0.0}
    assert done[0] == "a"
    assert sorted(done) == ["a", "b", "c"]
    assert (folder / "b.json").read_text() == "0.25"
    with pytest.raises(ZeroDivisionError):
        run_jobs(truediv, {**DIVISIONS, "d": (1, 0)}, folder, address=address)
    assert not (folder / "d.json").exists()


def test_dask_cluster(dask_address: str, tmp_path: Path) -> None:
    check_cluster(dask_address, tmp_path)


def test_worker_with_threads_runs_one_job_at_a_time(dask_address: str, tmp_path: Path) -> None:
    jobs = {f"job_{k}": (0.05 + 1e-3 * k,) for k in range(6)}
    results = run_jobs(running_together, jobs, tmp_path, address=dask_address)
    assert {result["most"] for result in results.values()} == {1}


@pytest.mark.slow
def test_ray_cluster(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    # "local": its own cluster, whatever another one has left behind on this machine
    ray.init("local", num_cpus=1, include_dashboard=False, log_to_driver=False)
    try:
        check_cluster("ray://auto", tmp_path)
        assert ray.is_initialized()  # who found it running leaves it running
    finally:
        ray.shutdown()


@pytest.mark.parametrize("address", ["host:8786", "slurm://host", "dask://", "ray:/host"])
def test_wrong_addresses_say_what_would_be_right(address: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="dask://HOST:PORT"):
        run_jobs(truediv, DIVISIONS, tmp_path, address=address)


def test_cluster_that_does_not_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "_PATIENCE", 0.5)
    with pytest.raises(ParameterError, match="answers"):
        run_jobs(truediv, DIVISIONS, tmp_path, address="dask://127.0.0.1:1")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"torch_ekm\[cluster\]"):
        run_jobs(truediv, DIVISIONS, tmp_path, address="dask://127.0.0.1:1")
