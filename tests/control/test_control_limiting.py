"""The grip by the object, and how much of a step is made."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from torch_ekm.control import GripForceTask, LookAndMoveController, PoseTarget, Situation, StepBound
from torch_ekm.control.decision import Grip

DEG = math.pi / 180


def test_the_grip_follows_from_weight_friction_and_lever(pinch) -> None:
    """``f = 2.5/mu (m g/2 + 95 r)``: 80 g, mu = 0.9, contacts about 15 mm from the axis."""
    plant, model, seen = pinch
    lin = model.linearize(seen.state)
    task, axis = GripForceTask(least=1.0), LookAndMoveController(model, plant.rotation_axis).focus
    force = seen.fingertip_force
    at = Situation(
        plant.hand, axis, seen.state, seen.a, force, torch.zeros(6), torch.zeros(1), weight=0.08 * 9.81
    )
    arm = torch.linalg.cross(plant.rotation_axis.expand(3, 3), lin.contacts.point - seen.position)
    lever = float(torch.linalg.vector_norm(arm, dim=-1).max())
    assert task.wanted(lin, at) == pytest.approx(2.5 / 0.9 * (0.04 * 9.81 + 95 * lever), rel=1e-3)
    heavy = dataclasses.replace(at, weight=4.0)
    assert task.wanted(lin, heavy) == task.most == 8.5
    assert GripForceTask().wanted(lin, dataclasses.replace(at, weight=0.0)) >= 5.0
    tighter = dataclasses.replace(at, tighter=0.5)
    assert task.wanted(lin, tighter) == pytest.approx(task.wanted(lin, at) + 0.5)
    assert GripForceTask(force=4.0).wanted(lin, tighter) == 4.5


def test_a_step_is_cut_in_proportion_to_what_is_predicted_to_go_wrong(pinch) -> None:
    plant, model, seen = pinch
    controller = LookAndMoveController(model, plant.rotation_axis, bound=None)
    focus, target = controller.focus, PoseTarget.turned(seen.state, plant.rotation_axis, degrees=5.0)
    step = controller.decide(seen.state, seen.a, target)
    lin = step.linearization
    on = torch.zeros(6, dtype=torch.float64)
    at = Situation(plant.hand, focus, seen.state, seen.a, None, on, torch.zeros(1), weight=0.8)
    firm = Grip(torch.ones(3), torch.ones(3), 1.0)

    def share(delta_a=None, off=on, asked: float = 1.0, seen: Situation = at, grip: Grip = firm) -> float:
        still = torch.zeros(plant.hand.n_a, dtype=torch.float64) if delta_a is None else delta_a
        predicted = torch.cat([torch.zeros(plant.hand.n_q, dtype=torch.float64), off])
        decided = dataclasses.replace(step, delta_a=still, predicted=predicted, grip=grip)
        return StepBound().share(decided, seen, asked)

    assert share() == 1.0
    assert share(off=3 * DEG * focus.off_matrix[~focus.off_translation][0]) == pytest.approx(0.5)
    carried = 10e-3 * focus.off_matrix[focus.off_translation][0]
    shares = [share(off=carried, asked=asked) for asked in (0.3, 0.5, 1.0, 2.0)]
    assert shares == pytest.approx([1.0, 0.7, 0.35, 0.25])  # none below 0.35 of the largest step
    still = torch.zeros(plant.hand.n_a, dtype=torch.float64)
    slopes = torch.autograd.functional.jacobian(lin.margins_after, still)  # [N/rad]
    slides = -slopes[0]
    slides *= 40.0 / float(slides.square().sum())  # [N] that the margin falls by
    assert share(slides, asked=2.0) < 1.0
    grips = [firm._replace(wanted=wanted) for wanted in (1 / 1.2, 1 / 0.75, 1 / 0.65, 1 / 0.55, 1 / 0.3, 0.0)]
    assert [grip.bears for grip in grips] == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0, 1.0])
    assert [bool(grip.waits) for grip in grips] == [False, False, True, True, True, False]
    felt = dataclasses.replace(at, fingertip_force=seen.fingertip_force)
    assert [share(seen=one, grip=grips[3]) for one in (at, felt)] == [0.35, 0.0]  # an estimate does not wait
    # a motion that takes the margins away: the heavier the object, the less of it is made
    delta = 4 * DEG * -torch.sign(slopes.sum(0))
    heavier = [dataclasses.replace(at, weight=weight) for weight in (0.3, 3.0)]
    shares = [share(delta, asked=10.0, seen=one) for one in heavier]
    assert 0 < shares[1] < shares[0] < 1


def test_a_measured_grip_that_is_too_weak_is_tightened_and_not_turned(pinch) -> None:
    plant, model, seen = pinch
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    felt = torch.tensor([2.9, 1.4, 1.4, 0.0, 0.0], dtype=torch.float64)
    decision = LookAndMoveController(model, plant.rotation_axis).decide(seen.state, seen.a, target, felt)
    assert 0.0 < float(decision.desired.norm()) < 0.3 * DEG
    change = decision.linearization.normal_force_sensitivity @ decision.delta_a
    assert float(change[0]) > 0.3  # [N]
