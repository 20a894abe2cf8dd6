"""A grasp is one before it is turned, and no finger fades unnoticed."""

import dataclasses

import pytest
import torch
from fakes import FakePlant, HoldingPlant

from torch_ekm.control import (
    ClosedLoop,
    LookAndMoveController,
    NormalForceLimit,
    PoseTarget,
    Safety,
    StoppingRule,
)
from torch_ekm.control import StopReason as Reason
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.kinematics.se3 import exp
from torch_ekm.plant import Observation

DEG = torch.pi / 180
SAFETY = Safety(StoppingRule(max_steps=12))


class Pads(HoldingPlant):
    """After each command the pads read what ``force`` says; the object is turned by ``turn``."""

    def __init__(self, seen: Observation, force) -> None:
        super().__init__(seen)
        self.force = force
        self.turn = torch.zeros(3, dtype=torch.float64)

    def observe(self) -> Observation:
        felt = self.seen.fingertip_force.clone()
        felt[:3] = torch.as_tensor(self.force(len(self.commands)), dtype=torch.float64)
        return self.reading(rotation=exp(self.turn) @ self.seen.rotation, fingertip_force=felt)


def turned(pinch, force, learns: bool = False, safety: Safety = SAFETY):
    plant, model, seen = pinch
    pads, chosen = Pads(seen, force), EnhancedModel.for_grasp(model, seen.state) if learns else model
    loop = ClosedLoop(pads, LookAndMoveController(chosen, plant.rotation_axis), safety=safety)
    return loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)), pads


@pytest.mark.parametrize("learns", [True, False])
def test_a_finger_that_bears_nothing_is_gripped_before_the_turn_in_one_movement(pinch, learns) -> None:
    done, _ = turned(pinch, lambda n: [5.0, 2.5, 0.4 if n < 1 else 2.5], learns)
    assert done.reason is not Reason.WEAK_GRASP
    assert [step.decision.turns for step in done.steps[:2]] == [False, True]
    grips, turn = (step.decision.predicted[-3:].norm() for step in done.steps[:2])
    assert float(grips) < 0.5 * DEG < float(turn)


@pytest.mark.parametrize("learns", [True, False])
def test_a_grasp_that_stays_weak_is_declined_with_the_fingers_name(pinch, learns) -> None:
    done, _ = turned(pinch, lambda n: [5.0 + 0.01 * n, 2.5 - 0.01 * n, 0.4], learns)
    assert done.reason is Reason.WEAK_GRASP
    assert not done.lost
    assert "finger 'middle' bears 0.4 N of 1." in done.stop.message
    assert 0 < len(done.steps) <= 4
    assert not any(step.decision.turns for step in done.steps)


def test_without_fingertips_nothing_is_declined(pinch) -> None:
    plant, model, seen = pinch
    blind = dataclasses.replace(seen, fingertip_force=None)
    weak = LookAndMoveController(model, plant.rotation_axis, limits=[NormalForceLimit(minimum=9.0)])

    class Still(FakePlant):
        def observe(self) -> Observation:
            return blind

    done = ClosedLoop(Still(), weak, safety=SAFETY).run(
        PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    )
    assert done.reason is not Reason.WEAK_GRASP


def test_the_least_force_of_a_finger_follows_from_the_grip(pinch) -> None:
    plant, model, seen = pinch
    controller = LookAndMoveController(model, plant.rotation_axis)
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=5.0)
    grip = controller.decide(seen.state, seen.a, target, seen.fingertip_force).grip
    wanted = 5.6  # of the thumb: the fingers share it
    thumb, *others = grip.least.tolist()
    assert 2 * others[0] == pytest.approx(thumb)
    assert thumb == pytest.approx(NormalForceLimit().share * wanted, abs=0.6)


@pytest.mark.parametrize(("force", "believed"), [([5.0, 2.5, 2.5], False), ([2.0, 5.0, 0.0], True)])
def test_a_pose_that_jumps_is_the_objects_where_the_grip_changes_with_it(pinch, force, believed) -> None:
    class Jumps(Pads):
        def move(self, delta_a: torch.Tensor) -> None:
            super().move(delta_a)
            self.turn = (len(self.commands) == 2) * 65 * DEG * pinch[0].rotation_axis

    plant, model, seen = pinch
    rule = dataclasses.replace(SAFETY.rule, off_limit=100 * DEG)
    pads = Jumps(seen, lambda n: force if n == 2 else [5.0, 2.5, 2.5])
    loop = ClosedLoop(pads, LookAndMoveController(model, plant.rotation_axis), safety=Safety(rule))
    done = loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0))
    assert (done.reason is not Reason.POSE_JUMP) is believed
    assert any("the object has slid" in step.note for step in done.steps) is believed
