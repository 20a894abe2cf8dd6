"""Jobs: parallel equals serial, an interrupted run resumes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from torch_ekm.exceptions import WorkerDiedError
from torch_ekm.experiments import jobs as module
from torch_ekm.experiments.jobs import read_result, run_jobs


def square(x: int) -> dict[str, float]:
    if x < 0:
        raise ValueError("negative")
    return {"x": x, "square": x**2}


def test_parallel_equals_serial_in_fresh_workers_that_take_closures(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_WATCH", 7.0)  # a forked worker would see it
    factor = 3
    jobs = {f"job_{x}": (x,) for x in range(4)}

    def work(x: int) -> list:
        return [{**square(x), "product": factor * x}, module._WATCH]

    serial = run_jobs(work, jobs, tmp_path / "serial")
    parallel = run_jobs(work, jobs, tmp_path / "parallel", processes=2)
    assert list(serial) == list(parallel) == list(jobs)
    assert [result for result, _ in serial.values()] == [result for result, _ in parallel.values()]
    assert serial["job_3"] == [{"x": 3, "square": 9, "product": 9}, 7.0]
    assert {watch for _, watch in parallel.values()} == {0.25}


def test_loops_are_compiled_before_the_first_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results would depend on when they are, by rounding."""
    done: list[str] = []
    monkeypatch.setattr(module, "warm_up", lambda: done.append("loops"))
    for _ in range(2):  # the second time there is nothing to do
        run_jobs(lambda: done.append("job"), {"a": ()}, tmp_path)
    assert done == ["loops", "job"]


def test_interrupted_run_resumes(tmp_path: Path) -> None:
    done: list[str] = []
    with pytest.raises(ValueError, match="negative") as told:
        run_jobs(square, {"a": (1,), "b": (-1,), "c": (2,)}, tmp_path, on_done=done.append)
    assert done == ["a"]
    assert told.value.__notes__ == ["in the job 'b'"]
    calls: list[int] = []

    def counted(x: int) -> dict[str, float]:
        calls.append(x)
        return square(x)

    (tmp_path / "c.json").write_text('{"x": 2, "squ')  # killed while writing, by something less careful
    with pytest.warns(UserWarning, match=r"c\.json: no JSON"):
        result = run_jobs(counted, {"a": (1,), "b": (3,), "c": (2,)}, tmp_path)
    assert calls == [3, 2]
    assert result["b"]["square"] == 9


def test_a_result_is_that_of_its_job(tmp_path: Path) -> None:
    jobs = {"a": (1,), "b": (2,)}
    whole = run_jobs(square, jobs, tmp_path)
    mine, other = ((tmp_path / f"{name}.json").read_bytes() for name in "ab")
    for wrong in (b"{}", b"null", b"[]", b'{"x": 1, "square": 1}', other, b"[" * 100_000):
        (tmp_path / "a.json").write_bytes(wrong)
        with pytest.warns(UserWarning, match=r"a\.json.*run again"):
            assert run_jobs(square, jobs, tmp_path) == whole
        assert (tmp_path / "a.json").read_bytes() == mine
    (tmp_path / "a.json").write_bytes(other)
    with pytest.raises(ValueError, match="another job, 'b'"):
        read_result(tmp_path / "a.json", "a")


def test_a_failure_cancels_what_has_not_begun(tmp_path: Path) -> None:
    def mark(folder: str, x: int) -> int:  # local, so that its process need not import this file
        """Leaves a trace; the job 0 fails, and no other ends before."""
        first = Path(folder) / "0"
        (Path(folder) / str(x)).touch()
        if x == 0:
            raise ValueError("job 0")
        while not first.exists():
            time.sleep(0.05)
        time.sleep(0.3)
        return x

    traces = tmp_path / "traces"
    traces.mkdir()
    with pytest.raises(ValueError, match="job 0") as told:
        run_jobs(mark, {f"job_{x}": (str(traces), x) for x in range(60)}, tmp_path / "runs", processes=2)
    assert told.value.__notes__ == ["in the job 'job_0'"]
    time.sleep(0.5)  # what had begun ends
    begun = len(list(traces.iterdir()))
    time.sleep(0.5)
    assert len(list(traces.iterdir())) == begun < 60


def test_a_run_whose_process_was_killed_says_so_and_goes_on(tmp_path: Path) -> None:
    def die(folder: str, x: int) -> int:
        """The process of the job 1 is killed from outside, once, when the job 0 is done."""
        died = Path(folder) / "died"
        while x == 1 and not (Path(folder) / "job_0.json").exists():
            time.sleep(0.05)
        if x == 1 and not died.exists():
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return x

    jobs = {f"job_{x}": (str(tmp_path), x) for x in range(2)}
    with pytest.raises(WorkerDiedError, match="the same call goes on"):
        run_jobs(die, jobs, tmp_path, processes=2)
    assert read_result(tmp_path / "job_0.json", "job_0") == 0
    assert run_jobs(die, jobs, tmp_path) == {"job_0": 0, "job_1": 1}


SLEEPERS = """
import signal, sys, time
from pathlib import Path
from torch_ekm.experiments.jobs import run_jobs

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what it runs behind without one

def work(x):
    time.sleep(0.1 if x < 2 else 600)
    return x

def tell(name):
    print(name, flush=True)

run_jobs(work, {f"job_{x}": (x,) for x in range(6)}, Path(sys.argv[1]), 2, on_done=tell)
"""


def test_ctrl_c_leaves_what_is_finished_and_nothing_hangs(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SLEEPERS, str(tmp_path)]
    # a group of its own, as a terminal has: Ctrl-C goes to the workers too
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as run:
        assert {run.stdout.readline().strip(), run.stdout.readline().strip()} == {"job_0", "job_1"}
        time.sleep(0.5)
        workers = children(run.pid)
        assert len(workers) >= 2
        os.killpg(run.pid, signal.SIGINT)
        _, errors = run.communicate(timeout=120)  # long before the jobs would have ended
    assert "KeyboardInterrupt" in errors
    assert ended(workers)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", "job_0.json", "job_1.json"]


def test_processes_end_with_their_parent(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SLEEPERS, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        run.stdout.readline()
        workers = children(run.pid)
        assert len(workers) >= 2
        run.kill()
    assert ended(workers)
    with pytest.raises(FileNotFoundError):  # nothing is written after its end
        read_result(tmp_path / "job_5.json", "job_5")


def children(pid: int) -> list[psutil.Process]:
    return psutil.Process(pid).children(recursive=True)


def ended(processes: list[psutil.Process]) -> bool:
    """Long before the jobs would have ended."""
    return not psutil.wait_procs(processes, timeout=120)[1]
