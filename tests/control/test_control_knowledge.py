"""What was learned of a hand goes from loop to loop and from session to session."""

from __future__ import annotations

import math

import pytest
import torch
from obedient_plant import Obedient

from torch_ekm.control import (
    ClosedLoop,
    DescribedFigures,
    HandKnowledge,
    LookAndMoveController,
    PoseTarget,
    StopReason,
)
from torch_ekm.control.force_sensitivity import ForceSensitivity
from torch_ekm.enhanced import EnhancedModel, save
from torch_ekm.exceptions import FileFormatError, ParameterError, StateMismatchError
from torch_ekm.kinematics import ServoModel
from torch_ekm.kinematics.servo_model import IdealServos
from torch_ekm.residual import SparseOnlineGP

DEG = math.pi / 180


@pytest.fixture(scope="module")
def driven(held) -> ClosedLoop:
    seen, axis, model = held
    controller = LookAndMoveController(EnhancedModel.for_grasp(model, seen.state), axis)
    loop = ClosedLoop(Obedient(model, seen), controller)
    loop.run(PoseTarget.turned(seen.state, axis, degrees=15))
    return loop


def test_a_file_gives_back_the_same_to_the_bit(driven, tmp_path) -> None:
    driven.knowledge.save(tmp_path / "hand.ekm")
    again = HandKnowledge.load(tmp_path / "hand.ekm")
    before, after = driven.knowledge.state_dict(), again.state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert float(again.servo.standard_errors.min()) < 0.1 * DEG  # 0.3 before anything was learned


def test_the_pace_of_the_last_turn_is_kept_if_it_reached_its_target(held) -> None:
    seen, axis, model = held
    controller = LookAndMoveController(EnhancedModel.for_grasp(model, seen.state), axis)
    loop = ClosedLoop(Obedient(model, seen), controller)
    target = PoseTarget.turned(seen.state, axis, degrees=15)
    assert float(loop.knowledge.pace) == 0.0
    assert loop.run(target).reason is StopReason.REACHED
    assert float(loop.knowledge.pace) == controller.pace.factor > 0
    kept = float(loop.knowledge.pace)
    still = ClosedLoop(Obedient(model, seen), controller, knowledge=loop.knowledge, learn=False)
    still.run(PoseTarget.turned(seen.state, axis, degrees=150))
    assert float(loop.knowledge.pace) == kept  # it does not learn
    far = ClosedLoop(Obedient(model, seen), controller, knowledge=loop.knowledge, decline=False)
    assert far.run(PoseTarget.turned(seen.state, axis, degrees=150)).reason is not StopReason.REACHED
    assert float(loop.knowledge.pace) == 0.0


def test_the_next_loop_goes_on_with_it(held, driven) -> None:
    seen, axis, model = held
    loop = ClosedLoop(Obedient(model, seen), LookAndMoveController(model, axis), knowledge=driven.knowledge)
    before = driven.knowledge.servo.weight.clone()
    loop.run(PoseTarget.turned(seen.state, axis, degrees=5))
    assert loop.knowledge is driven.knowledge
    assert bool((driven.knowledge.servo.weight != before).any())


def test_a_plain_model_learns_nothing_of_the_servos(held) -> None:
    seen, axis, model = held
    plant = Obedient(model, seen)
    loop = ClosedLoop(plant, LookAndMoveController(model, axis))
    steps = loop.run(PoseTarget.turned(seen.state, axis, degrees=5)).steps
    assert isinstance(loop.knowledge.servo, IdealServos)
    for step, given in zip(steps, plant.given, strict=True):  # commands are those that were decided
        assert torch.equal(step.decision.delta_a, given)


def test_knowledge_of_another_hand_and_another_file_are_refused(held, driven, tmp_path) -> None:
    seen, axis, model = held
    with pytest.raises(ParameterError, match="a hand with the actuators"):
        ClosedLoop(
            Obedient(model, seen),
            LookAndMoveController(model, axis),
            knowledge=HandKnowledge(ServoModel(["one", "two"]), ForceSensitivity(5, 2), DescribedFigures()),
        )
    other = HandKnowledge(
        ServoModel(model.hand.actuator_names), ForceSensitivity(2, model.hand.n_a), DescribedFigures()
    )
    with pytest.raises(ParameterError, match="a hand with 5 pads and 9 actuators"):
        other.check(model.hand)
    save(SparseOnlineGP(2, 1), tmp_path / "learner.ekm")
    with pytest.raises(FileFormatError, match="holds a SparseOnlineGP, no HandKnowledge"):
        HandKnowledge.load(tmp_path / "learner.ekm")


@pytest.mark.parametrize("spoilt", [math.nan, math.inf])
def test_a_state_with_nan_is_refused_and_nothing_is_changed(driven, spoilt) -> None:
    knowledge = HandKnowledge.of(driven.controller.kinematic.hand)
    before = {name: value.clone() for name, value in knowledge.state_dict().items()}
    state = {name: value.clone() for name, value in driven.knowledge.state_dict().items()}
    state["figures.mean"][0] = spoilt
    with pytest.raises(StateMismatchError, match=r"figures\.mean"):
        knowledge.load_state_dict(state)
    assert all(torch.equal(before[name], value) for name, value in knowledge.state_dict().items())
    knowledge.load_state_dict(driven.knowledge.state_dict())
    assert torch.equal(knowledge.figures.mean, driven.knowledge.figures.mean)


def test_what_motions_taught_can_be_taken_back(driven) -> None:
    knowledge, n_a = HandKnowledge.of(driven.controller.kinematic.hand), 9
    states = []
    for motion in range(12):
        states.append({name: value.clone() for name, value in knowledge.state_dict().items()})
        knowledge.checkpoint()
        knowledge.servo.update(*torch.full((2, n_a), 0.01 * (motion + 1), dtype=torch.float64))
        knowledge.forces.update(torch.full((n_a,), 0.01), torch.ones(5), torch.ones(5, n_a))
        knowledge.pace.fill_(1 + 0.01 * motion)

    def as_before(motion: int) -> bool:
        now = knowledge.state_dict()
        return all(torch.equal(now[name], value) for name, value in states[motion].items())

    assert knowledge.take_back() == 1
    assert as_before(11)
    assert not as_before(10)
    assert knowledge.take_back(3) == 3
    assert as_before(8)
    assert knowledge.take_back(100) == 4
    assert as_before(4)
    assert knowledge.take_back() == 0
    assert as_before(4)
    knowledge.checkpoint()
    knowledge.load_state_dict(knowledge.state_dict())
    assert knowledge.take_back() == 0  # of another state
