"""The closed loop on plants that misbehave."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from torch_ekm.control import (
    ControllerOptions,
    FocusedPose,
    LookAndMoveController,
    PoseTarget,
    StoppingRule,
)
from torch_ekm.control import StopReason as Reason
from torch_ekm.exceptions import NonFiniteError
from torch_ekm.experiments.manipulation import run_manipulation, state_of
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.plant.plant import Observation, Plant, PlantStatus
from torch_ekm.simulation import SimulatedHand

DEG = math.pi / 180
RULE = StoppingRule(tolerance=0.25 * DEG, stall_window=3, stall_progress=0.1 * DEG, max_steps=5)


class FrozenPlant:
    """Never moves; what it reports can be changed from some command on."""

    def __init__(self, observation: Observation, change=None, after: int = 2) -> None:
        self.observation, self.change, self.after, self.commands = observation, change, after, 0

    def reset(self, seed: int) -> Observation:
        return self.observation

    def observe(self) -> Observation:
        if self.change is not None and self.commands >= self.after:
            return self.change(self.observation)
        return self.observation

    def command(self, delta_a: torch.Tensor) -> Observation:
        self.commands += 1
        return self.observe()

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def held():
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=4)
    model = KinematicModel(plant.hand, plant.object)
    axis = plant.rotation_axis
    loop = LookAndMoveController(model, FocusedPose.rotation_about(axis), ControllerOptions())
    return seen, axis, loop


def drive(held, change=None, angle: float = 80.0, rule: StoppingRule = RULE):
    seen, axis, loop = held
    plant = FrozenPlant(seen, change)
    assert isinstance(plant, Plant)
    target = PoseTarget.turned(state_of(seen), axis, angle * DEG)
    return run_manipulation(plant, loop, target, rule, learn=False), plant


def test_target_that_cannot_be_reached_stalls_and_says_so(held) -> None:
    done, plant = drive(held)
    assert done.reason is Reason.STALLED
    assert done.steady_state_error == pytest.approx(80 * DEG)
    assert plant.commands == len(done.steps) == 3


def test_step_limit(held) -> None:
    patient = dataclasses.replace(RULE, stall_window=50)
    done, plant = drive(held, rule=patient)
    assert done.reason is Reason.STEP_LIMIT
    assert plant.commands == 5


def test_target_that_is_reached_already_needs_no_command(held) -> None:
    done, plant = drive(held, angle=0.1)
    assert done.reason is Reason.REACHED
    assert plant.commands == 1  # seen twice within the tolerance


def test_lost_object_ends_the_manipulation(held) -> None:
    done, plant = drive(held, lambda seen: dataclasses.replace(seen, status=PlantStatus.LOST))
    assert done.reason is Reason.OBJECT_LOST
    assert done.lost
    assert plant.commands == 2


def test_dislocation_counts_as_lost(held) -> None:
    across = torch.linalg.cross(held[1], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    across = across / torch.linalg.vector_norm(across)

    def dislocate(seen: Observation) -> Observation:
        return dataclasses.replace(seen, rotation=exp(40 * DEG * across) @ seen.rotation)

    done, _ = drive(held, dislocate)
    assert done.reason is Reason.OBJECT_LOST
    assert "dislocated" in done.message


def test_object_out_of_reach_of_the_fingers_is_lost(held) -> None:
    done, _ = drive(held, lambda seen: dataclasses.replace(seen, position=seen.position + 0.2))
    assert done.reason is Reason.OBJECT_LOST
    assert "touches" in done.message


def test_observation_that_is_not_finite_is_refused(held) -> None:
    with pytest.raises(NonFiniteError, match=r"Observation\.position"):
        drive(held, lambda seen: dataclasses.replace(seen, position=seen.position * math.nan))
