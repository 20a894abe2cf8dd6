"""Grasps that tests of the controller begin with; no test moves their hands."""

import functools

import pytest

from torch_ekm.model import KinematicModel
from torch_ekm.simulation import SimulatedHand


@functools.cache  # in a fixture of a session steps would be the usual ones
def _held(seed: int):
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=seed)
    return plant, KinematicModel(plant.hand, plant.object), seen


@pytest.fixture
def grasp():
    """A held box: plant, kinematic model, first observation and its state."""
    return *_held(3), _held(3)[2].state


@pytest.fixture(scope="module")
def pinch():
    """Another: plant, kinematic model, first observation."""
    return _held(4)


@pytest.fixture(scope="module")
def held(pinch):
    """Its first observation, axis and kinematic model."""
    plant, model, seen = pinch
    return seen, plant.rotation_axis, model
