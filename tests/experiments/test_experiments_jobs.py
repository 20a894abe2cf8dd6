"""Jobs: parallel equals serial, and an interrupted run resumes."""

from __future__ import annotations

from pathlib import Path

import pytest

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
