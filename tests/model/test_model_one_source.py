"""What plant and model, or two parts of the model, share is said once; linearize remembers nothing."""

from __future__ import annotations

import pytest
import torch
from model_toys import F64, three_finger

from torch_ekm.model import KinematicModel, ModelStatus
from torch_ekm.simulation import PlantConfig, SimulatedHand


@pytest.mark.parametrize("gravity", [None, (0.0, -9.81, 0.0)])
def test_the_model_of_a_plant_is_made_with_its_gravity(gravity):
    plant = SimulatedHand("icub_right", "box", PlantConfig(gravity=gravity))
    model = KinematicModel(plant.hand, plant.object)
    plant.reset(0)
    assert plant.hand.gravity == (gravity or (0.0, 0.0, 9.81))
    expected = plant.object.mass * torch.tensor(plant.hand.gravity, dtype=F64)
    assert torch.equal(model.weight, expected)


def test_a_linearization_depends_on_its_arguments_alone():
    toy = three_finger()
    model = toy.model
    slippery = toy.contacts.replace(friction=torch.full((3,), 0.01, dtype=F64))
    first = model.linearize(toy.state, slippery)
    good = model.linearize(toy.state)
    again = model.linearize(toy.state, slippery)
    assert first.status is again.status is ModelStatus.NO_FORCES
    assert torch.equal(first.manipulation_jacobian, again.manipulation_jacobian)
    assert not torch.equal(good.manipulation_jacobian, again.manipulation_jacobian)
