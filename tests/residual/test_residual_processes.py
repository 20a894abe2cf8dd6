"""A learner in threads, in other processes, and on a screen; targets without an axis of their own."""

import copy
import multiprocessing
import pickle
import threading
import time

import pytest
import torch

import torch_ekm
from torch_ekm.residual import (
    LinearKernel,
    MixtureResidual,
    RecursiveLeastSquares,
    ReplayMLP,
    SparseOnlineGP,
    default_learner,
)
from torch_ekm.residual.sparse_gp.engine import compiled


def learned(make, n: int = 40):
    g = torch.Generator().manual_seed(0)
    x = torch.rand(n, 2, generator=g, dtype=torch.float64)
    learner = make(2, 1)
    learner.update(x, x[:, :1])
    return learner, x


def _learn(learner, done) -> None:
    for k in range(30):
        learner.update(torch.full((2,), 0.1 * k), torch.tensor([5.0]))
    done.put(float(learner(torch.full((2,), 0.1))))


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_what_another_process_learns_is_not_learned_here(method):
    """torch shares a tensor's memory with a process to which it is sent."""
    learner, _ = learned(SparseOnlineGP)
    x = torch.full((2,), 0.1)
    before = learner(x).item()
    context = multiprocessing.get_context(method)
    done = context.Queue()
    process = context.Process(target=_learn, args=(learner, done), daemon=True)
    process.start()
    there = done.get(timeout=300)
    process.join()
    assert learner(x).item() == before != there


@pytest.mark.parametrize("do", [copy.deepcopy, pickle.dumps, "load", "save"])
def test_a_copy_is_of_one_moment(do, tmp_path):
    """It waits for an update under way."""
    learner, _ = learned(SparseOnlineGP)
    calls = {
        "load": learner.load_state_dict,
        "save": lambda of: torch_ekm.save(learner, tmp_path / "learner"),
    }
    of = learner.state_dict() if do == "load" else learner
    thread = threading.Thread(target=calls.get(do, do), args=(of,))
    with learner.lock:
        thread.start()
        thread.join(0.1)
        assert thread.is_alive()
    thread.join(60)
    assert not thread.is_alive()


def test_two_threads_know_the_same_memory(monkeypatch):
    """Else a rebuild would miss what a sample has written for the other one."""

    class Slow(compiled.Plan):
        def __init__(self, gp) -> None:
            super().__init__(gp)
            first = gp is learner.members[0]  # one thread is late with it, the other one with the rest
            time.sleep(0.05 if first is (threading.current_thread() is asking) else 0.0)

    monkeypatch.setattr(compiled, "Plan", Slow)
    learner, x = default_learner(2, 1), torch.linspace(0, 1, 18, dtype=torch.float64).view(9, 2)
    asking = threading.Thread(target=lambda: [learner(row) for row in x])
    asking.start()
    learner.update(x, x[:, :1])
    asking.join()
    bound = learner._engine._bound
    assert all(plan is one.engine._plan for plan, one in zip(bound.plans, bound.learners, strict=True))


@pytest.mark.parametrize("name", ["gain", "learners.0.posterior.basis"])
def test_memory_that_torch_has_moved_is_found(name):
    """As it does with a tensor that is sent to a process."""
    (moved, x), (other, _) = (learned(lambda d, m: MixtureResidual(SparseOnlineGP(d, m))) for _ in range(2))
    moved.get_buffer(name).share_memory_()
    for learner in (moved, other):
        learner.update(x, -x[:, 1:])
    assert torch.equal(moved(x), other(x))


def test_a_fork_while_another_thread_updates_goes_on():
    """Its lock would be held for ever there; torch's threads would be waited for."""
    learner, x = learned(lambda d, m: SparseOnlineGP(d, m, kernel=LinearKernel(d)))
    stop = threading.Event()

    def work() -> None:
        while not stop.is_set():
            learner.update(x[0], x[0, :1])

    thread = threading.Thread(target=work)
    thread.start()
    context = multiprocessing.get_context("fork")
    try:
        for _ in range(4):
            done = context.Queue()
            process = context.Process(target=_learn, args=(learner, done), daemon=True)
            process.start()
            done.get(timeout=300)
            process.join()
    finally:
        stop.set()
        thread.join()
    learner.update(x[0], x[0, :1])


@pytest.mark.parametrize("make", [default_learner, SparseOnlineGP, RecursiveLeastSquares, ReplayMLP])
def test_an_optimiser_finds_nothing_to_move_and_says_so(make):
    """Only the learner moves its hyperparameters: an optimiser would leave its caches stale."""
    with pytest.raises(ValueError, match="empty parameter list"):
        torch.optim.Adam(make(2, 1).parameters())


@pytest.mark.parametrize("make", [default_learner, SparseOnlineGP, RecursiveLeastSquares, ReplayMLP])
def test_the_axis_of_a_single_output_may_be_left_out(make):
    learner, x = learned(make)
    other = make(2, 1)
    other.update(x, x[:, 0])
    assert torch.equal(other(x), learner(x))
    for one, y in ((learner, x[0, :1]), (other, x[0, 0])):
        one.update(x[0], y)
    assert torch.equal(other(x), learner(x))


def test_it_may_be_left_out_in_a_fleet():
    fleets = [SparseOnlineGP(2, 1, batch_shape=(3,)) for _ in range(2)]
    x = torch.rand(5, 3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    fleets[0].update(x, x[..., :1])
    fleets[1].update(x, x[..., 0])
    assert torch.equal(fleets[0](x), fleets[1](x))


@pytest.mark.parametrize(
    "make",
    [default_learner, lambda d, m: MixtureResidual([SparseOnlineGP(d, m), RecursiveLeastSquares(d, m)])],
    ids=["default", "two"],
)
def test_a_print_fits_on_a_screen_and_says_what_is_known(make):
    learner = make(20, 2)
    x = torch.rand(40, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    learner.update(x, x[:, :2])
    lines = repr(learner).splitlines()
    assert len(lines) < 24
    text = "\n".join(lines)
    for words in ("in_features=20", "40 samples", "40 of 100 points", "noise of y", "units: (x - ["):
        assert words in text
    of_learners = [line.split("[")[1].split("]")[0] for line in lines if line.startswith("    [")]
    assert len(of_learners) == len(learner.members)
    for told, weights in zip(of_learners, learner.weights.unbind(-1), strict=True):
        found = torch.tensor([float(w) for w in told.split(", ")], dtype=torch.float64)  # one where equal
        torch.testing.assert_close(found.expand_as(weights), weights, rtol=0.0, atol=0.01)
