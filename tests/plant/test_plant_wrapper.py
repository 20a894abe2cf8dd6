"""What is put around a plant passes on all that it does not change."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from fakes import FakePlant

from torch_ekm.exceptions import NonFiniteError, ParameterError, StateError
from torch_ekm.plant import Observation, Plant, PlantWrapper, RecordingPlant, ReplayedPlant, Truth

EYE, ORIGIN = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)


class Counter(FakePlant):
    """Reports how often it was commanded."""

    rotation_axis = "beyond the contract"

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def reset(self, seed: int) -> Observation:
        self.count = seed
        return self.observe()

    def observe(self) -> Observation:
        q = torch.full((2,), float(self.count), dtype=torch.float64)
        return Observation(q, q[:1], ORIGIN, EYE, q[:1], truth=Truth(q, ORIGIN, EYE))

    def move(self, delta_a: torch.Tensor) -> None:
        self.count += int(delta_a)


class Shifted(PlantWrapper):
    """Joints read 10 too large."""

    def observation(self, seen: Observation) -> Observation:
        return dataclasses.replace(seen, q=seen.q + 10)


def test_a_wrapper_changes_every_observation_and_nothing_else() -> None:
    inner = Counter()
    plant = Shifted(Shifted(inner))
    assert isinstance(plant, Plant)
    assert float(plant.reset(3).q[0]) == 23
    assert float(plant.command(torch.tensor(2)).q[0]) == 25
    assert float(plant.observe().q[0]) == 25
    assert float(plant.observe().a[0]) == 5
    assert float(plant.observe().truth.q[0]) == 5
    assert plant.rotation_axis == "beyond the contract"
    plant.close()
    assert inner.closed


def test_what_no_plant_has_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = Shifted(Counter()).no_such_thing
    with pytest.raises(AttributeError, match="_private"):
        _ = Shifted(Counter())._private


def test_states_of_an_observation() -> None:
    seen = Shifted(Counter()).reset(1)
    assert torch.equal(seen.state.q, seen.q)
    assert torch.equal(seen.truth.state.q, seen.q - 10)
    with pytest.raises(NonFiniteError, match=r"Observation\.q"):
        dataclasses.replace(seen, q=seen.q * torch.nan)


@pytest.mark.usefixtures("unchecked")
def test_an_array_where_a_tensor_is_expected_is_named() -> None:
    seen = Counter().reset(1)
    for value in (seen.q.numpy(), seen.q.tolist(), None):
        with pytest.raises(ParameterError, match=r"Observation\.q = .*it must be a torch tensor"):
            dataclasses.replace(seen, q=value)
    assert dataclasses.replace(seen, fingertip_force=None).fingertip_force is None


def test_what_is_recorded_in_mid_grasp_can_be_replayed() -> None:
    inner = Counter()
    inner.reset(3)
    plant = RecordingPlant(inner)
    plant.command(torch.tensor(2))
    assert [int(seen.q[0]) for seen in plant.trajectory.observations] == [3, 5]
    again = ReplayedPlant(plant.trajectory)
    assert int(again.observe().q[0]) == 3
    assert int(again.command(torch.tensor(2)).q[0]) == 5
    with pytest.raises(StateError, match="the recording ends after 1 commands"):
        again.command(torch.tensor(2))
    looked = RecordingPlant(inner)
    looked.observe()
    looked.observe()
    assert len(looked.trajectory.observations) == 1
