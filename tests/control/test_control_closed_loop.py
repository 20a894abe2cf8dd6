"""The closed loop on plants that misbehave."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from torch_ekm.control import (
    ClosedLoop,
    LookAndMoveController,
    PoseTarget,
    StoppingRule,
)
from torch_ekm.control import StopReason as Reason
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import NonFiniteError
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, Plant, PlantStatus
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
    loop = LookAndMoveController(model, axis)
    return seen, axis, loop


def drive(held, change=None, angle: float = 80.0, rule: StoppingRule = RULE):
    seen, axis, loop = held
    plant = FrozenPlant(seen, change)
    assert isinstance(plant, Plant)
    target = PoseTarget.turned(seen.state, axis, degrees=angle)
    return ClosedLoop(plant, loop, rule).run(target), plant


def test_target_that_cannot_be_reached_stalls_and_says_so(held) -> None:
    done, plant = drive(held)
    assert done.reason is Reason.STALLED
    assert done.errors[-1] == pytest.approx(80 * DEG)
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
    assert "dislocated" in done.stop.message


def test_object_out_of_reach_of_the_fingers_is_lost(held) -> None:
    done, _ = drive(held, lambda seen: dataclasses.replace(seen, position=seen.position + 0.2))
    assert done.reason is Reason.OBJECT_LOST
    assert "touches" in done.stop.message


def test_observation_that_is_not_finite_is_refused(held) -> None:
    with pytest.raises(NonFiniteError, match=r"Observation\.position"):
        drive(held, lambda seen: dataclasses.replace(seen, position=seen.position * math.nan))


def test_steps_are_a_generator_that_tells_why_it_ends(held) -> None:
    seen, axis, loop = held
    plant = FrozenPlant(seen)
    motions = ClosedLoop(plant, loop, RULE).steps(PoseTarget.turned(seen.state, axis, degrees=80))
    first = next(motions)
    assert plant.commands == 1  # nothing runs ahead of its consumer
    assert first.before is seen
    assert first.report is None  # a kinematic model alone learns nothing
    torch.testing.assert_close(first.increment, torch.zeros_like(first.increment))
    assert len([next(motions) for _ in range(2)]) == 2
    with pytest.raises(StopIteration) as end:
        next(motions)
    assert end.value.value.reason is Reason.STALLED
    assert end.value.value.final is seen


def test_an_enhanced_model_learns_unless_told_not_to(held) -> None:
    seen, axis, loop = held
    target = PoseTarget.turned(seen.state, axis, degrees=80)
    for learn in (True, False):
        ekm = EnhancedModel.for_grasp(loop.kinematic, seen.state)
        controller = LookAndMoveController(ekm, axis)
        steps = ClosedLoop(FrozenPlant(seen), controller, RULE, learn=learn).run(target).steps
        assert [step.report is not None for step in steps] == [learn] * 3
        da = steps[0].decision.delta_a
        untouched = torch.equal(ekm(seen.state, da), loop.kinematic(seen.state, da))
        assert untouched is not learn
        if learn:  # it saw that nothing moves: it asks for more
            assert steps[-1].decision.delta_a.norm() > 2 * steps[0].decision.delta_a.norm()


def test_an_object_that_is_lost_teaches_nothing(held) -> None:
    seen, axis, loop = held
    controller = LookAndMoveController(EnhancedModel.for_grasp(loop.kinematic, seen.state), axis)
    plant = FrozenPlant(seen, lambda o: dataclasses.replace(o, status=PlantStatus.LOST))
    done = ClosedLoop(plant, controller, RULE).run(PoseTarget.turned(seen.state, axis, degrees=80))
    assert [step.report is not None for step in done.steps] == [True, False]
