"""Steps that a thread takes beside updates: nothing depends on how fast it is."""

from __future__ import annotations

import copy
import pickle
from concurrent.futures import Future

import pytest
import torch

from torch_ekm.residual import LearnHyperparameters, SparseOnlineGP, worker


def at_once(job) -> Future:
    done: Future = Future()
    done.set_result(job())
    return done


@pytest.mark.parametrize("memory", [0, 50])
def test_a_step_beside_updates_is_the_step_taken_at_once(memory, monkeypatch):
    made = [
        SparseOnlineGP(2, 1, capacity=20, parts=[LearnHyperparameters(steps=2, memory=memory)]) for _ in "ab"
    ]
    x = torch.rand(150, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for t, row in enumerate(x):
        made[0].update(row, row[:1].sin())
        with monkeypatch.context() as patch:
            patch.setattr(worker, "start", at_once)
            made[1].update(row, row[:1].sin())
        assert torch.equal(made[0](x), made[1](x)), t


@pytest.mark.parametrize("n", [28, 60, 62])
def test_a_copy_made_while_a_step_is_under_way_goes_on_the_same(n):
    """The last step before a rebuild, after 32 and 64 samples, begins four samples before it."""
    x = torch.rand(150, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    learner, loaded = (SparseOnlineGP(2, 1, capacity=20, parts=[LearnHyperparameters()]) for _ in range(2))
    learner.update(x[:n], x[:n, :1].sin())
    loaded.load_state_dict(learner.state_dict())
    others = [copy.deepcopy(learner), pickle.loads(pickle.dumps(learner)), loaded]
    for one in (learner, *others):
        one.update(x[n:], x[n:, :1].sin())
    assert all(torch.equal(one(x), learner(x)) for one in others)
