"""A grasp that tests of disturbances begin with."""

import pytest

from torch_ekm.simulation import SimulatedHand


@pytest.fixture(scope="module")
def plant():
    plant = SimulatedHand("icub_right", "box")
    plant.reset(0)
    return plant


@pytest.fixture(scope="module")
def grasped(plant):
    return plant.snapshot()


@pytest.fixture
def exact(plant, grasped):
    """The plant without any disturbance, freshly grasped."""
    plant.restore(grasped)
    yield plant
    plant.restore(grasped)
