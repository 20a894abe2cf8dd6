"""Grasps that tests of the controller begin with."""

from __future__ import annotations

import pytest

from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand


@pytest.fixture(scope="module")
def grasp():
    """A held box: plant, kinematic model, first observation and its state."""
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=3)
    model = KinematicModel(plant.hand, plant.object)
    return plant, model, seen, GraspState(seen.q, seen.position, seen.rotation)


@pytest.fixture(scope="module")
def pinch():
    """Another: plant, kinematic model, first observation."""
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=4)
    return plant, KinematicModel(plant.hand, plant.object), seen


@pytest.fixture(scope="module")
def held(pinch):
    """Its first observation, axis and kinematic model."""
    plant, model, seen = pinch
    return seen, plant.rotation_axis, model
