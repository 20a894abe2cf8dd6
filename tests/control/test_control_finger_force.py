"""A grasp is one before it is turned, and no finger fades unnoticed."""

from __future__ import annotations

import dataclasses
import math
from unittest.mock import MagicMock

import pytest
import torch
from fakes import FakePlant, HoldingPlant

from torch_ekm.control import (
    Caution,
    ClosedLoop,
    LookAndMoveController,
    NormalForceLimit,
    Pace,
    PaceOptions,
    PoseTarget,
    Safety,
    StoppingRule,
    TrustRegion,
)
from torch_ekm.control import StopReason as Reason
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.kinematics.se3 import exp
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation
from torch_ekm.simulation import SimulatedHand

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


@pytest.fixture(scope="module")
def held():
    plant = SimulatedHand("icub_right", "box")
    seen = plant.reset(seed=4)
    return plant, KinematicModel(plant.hand, plant.object), seen


def turned(held, force, safety: Safety = SAFETY):
    plant, model, seen = held
    pads = Pads(seen, force)
    loop = ClosedLoop(pads, LookAndMoveController(model, plant.rotation_axis), safety=safety)
    return loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)), pads, loop


def test_a_finger_that_bears_nothing_is_gripped_before_the_turn(held) -> None:
    done, _, _ = turned(held, lambda n: [5.0, 2.5, 0.4 if n < 2 else 2.5])
    assert done.reason is not Reason.WEAK_GRASP
    grips, turn = done.steps[1], done.steps[2]
    assert float(grips.decision.desired.abs().max()) == 0.0
    assert float(turn.decision.desired.abs().max()) > 1 * DEG


def test_a_grasp_that_stays_weak_is_declined_with_the_fingers_name(held) -> None:
    done, pads, _ = turned(held, lambda n: [5.0 + 0.01 * n, 2.5 - 0.01 * n, 0.4])
    assert done.reason is Reason.WEAK_GRASP
    assert not done.lost
    assert "finger 'middle' bears 0.4 N of 1." in done.stop.message
    assert len(pads.commands) == Caution().grips
    assert all(float(step.decision.desired.abs().max()) == 0.0 for step in done.steps)


def test_a_finger_that_fades_three_times_running_sends_the_hand_back(held) -> None:
    done, pads, loop = turned(held, lambda n: [5.0, 2.5, [1.6, 0.9, 0.6, 0.3, 2.0][min(n, 4)]])
    assert [step.retreat for step in done.steps][:4] == [False, False, False, True]
    torch.testing.assert_close(pads.commands[3], -pads.commands[2])
    assert loop.controller.tighter == Caution().tighten


def test_a_finger_that_lets_go_sends_the_hand_back(held) -> None:
    done, _, _ = turned(held, lambda n: [5.0, 2.5, [1.6, 0.9, 0.1, 0.0, 2.0][min(n, 4)]])
    assert [step.retreat for step in done.steps][:4] == [False, False, False, True]


def test_without_fingertips_nothing_is_declined(held) -> None:
    plant, model, seen = held
    blind = dataclasses.replace(seen, fingertip_force=None)
    weak = LookAndMoveController(model, plant.rotation_axis, limits=[NormalForceLimit(minimum=9.0)])

    class Still(FakePlant):
        def observe(self) -> Observation:
            return blind

    done = ClosedLoop(Still(), weak, safety=SAFETY).run(
        PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    )
    assert done.reason is not Reason.WEAK_GRASP


def test_a_finger_that_bears_enough_may_lose_force(held) -> None:
    done, _, _ = turned(held, lambda n: [5.0, 2.5, 4.0 - 0.4 * min(n, 6)])
    assert not any(step.retreat for step in done.steps)


def test_a_finger_that_fades_twice_slows_the_pace(held) -> None:
    plant, model, seen = held
    paces = []
    for force in ([1.6, 1.6, 1.6], [1.6, 0.9, 0.5]):
        enhanced = EnhancedModel.for_grasp(model, seen.state)
        pace = Pace(PaceOptions(trust=TrustRegion(smallest=0.01)))
        controller = LookAndMoveController(enhanced, plant.rotation_axis, pace=pace)
        loop = ClosedLoop(Pads(seen, lambda n, f=force: [5.0, 2.5, f[min(n, 2)]]), controller)
        steps = loop.steps(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0))
        next(steps)
        judge = controller.pace.judge
        controller.pace.judge = MagicMock(wraps=judge)  # type: ignore[method-assign]
        next(steps)
        paces.append(controller.pace.judge.call_args.args[0])
    assert paces[0] < paces[1] == math.inf


def test_the_least_force_of_a_finger_follows_from_the_grip(held) -> None:
    plant, model, seen = held
    controller = LookAndMoveController(model, plant.rotation_axis)
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=5.0)
    grip = controller.decide(seen.state, seen.a, target, seen.fingertip_force).grip
    assert grip is not None
    wanted = 5.6  # of the thumb: the fingers share it
    thumb, *others = grip.least.tolist()
    assert 2 * others[0] == pytest.approx(thumb)
    assert thumb == pytest.approx(NormalForceLimit().share * wanted, abs=0.6)


def test_a_pose_that_jumps_while_the_grip_changes_is_the_objects_and_the_hand_goes_back(held) -> None:
    plant, model, seen = held
    safety = dataclasses.replace(SAFETY, rule=dataclasses.replace(SAFETY.rule, off_limit=100 * DEG))
    reasons = []
    for force in ([5.0, 2.5, 2.5], [2.0, 5.0, 0.0]):

        class Jumps(Pads):
            def move(self, delta_a: torch.Tensor) -> None:
                super().move(delta_a)
                self.turn = (len(self.commands) == 2) * 65 * DEG * plant.rotation_axis

        pads = Jumps(seen, lambda n, f=force: f if n == 2 else [5.0, 2.5, 2.5])
        loop = ClosedLoop(pads, LookAndMoveController(model, plant.rotation_axis), safety=safety)
        done = loop.run(PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0))
        reasons.append((done.reason is Reason.POSE_JUMP, any(step.retreat for step in done.steps)))
    assert reasons == [(True, False), (False, True)]
