"""Copies and pickles of a model around a detector: whole, and apart from the original."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

from torch_ekm.enhanced import EnhancedModel
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand


@pytest.mark.parametrize(
    "again", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))], ids=["copy", "pickle"]
)
def test_a_copy_predicts_the_same_and_learns_alone(again) -> None:
    plant = SimulatedHand("icub_right", "box")
    state = plant.reset(0).state
    plant.close()
    f = KinematicModel(plant.hand, plant.object)
    model, da = EnhancedModel.for_grasp(f, state), torch.full((plant.hand.n_a,), 0.02, dtype=torch.float64)
    model.update(state, da, 1.3 * f(state, da))
    other = again(model)
    before = model.predict(state, da)
    assert torch.equal(other.predict(state, da).mean, before.mean)
    assert torch.equal(again(f)(state, da), f(state, da))
    for _ in range(3):
        other.update(state, da, 0.5 * f(state, da))
    assert torch.equal(model.predict(state, da).mean, before.mean)
    assert not torch.equal(other.predict(state, da).mean, before.mean)
