"""The grip by the object, and how much of a step is made."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from torch_ekm.control import GripForceTask, LookAndMoveController, PoseTarget, Situation, StepBound
from torch_ekm.control.limiting import grip_share
from torch_ekm.exceptions import ParameterError

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
    controller = LookAndMoveController(model, plant.rotation_axis)
    lin, focus = model.linearize(seen.state), controller.focus
    on = torch.zeros(6, dtype=torch.float64)
    at = Situation(plant.hand, focus, seen.state, seen.a, None, on, torch.zeros(1), weight=0.8)
    still, bound = torch.zeros(plant.hand.n_a, dtype=torch.float64), StepBound()
    predicted = torch.zeros(plant.hand.n_q + 6, dtype=torch.float64)
    assert bound.share(lin, still, predicted, at) == 1.0
    turned, carried = predicted.clone(), predicted.clone()
    turned[-6:] = 3 * DEG * focus.off_matrix[~focus.off_translation][0]
    assert bound.share(lin, still, turned, at) == pytest.approx(0.5)
    carried[-6:] = 10e-3 * focus.off_matrix[focus.off_translation][0]
    shares = [bound.share(lin, still, carried, at, asked) for asked in (0.3, 0.5, 1.0, 2.0)]
    assert shares == pytest.approx([1.0, 0.7, 0.35, 0.25])  # none below 0.35 of the largest step
    slides = -lin.margin_sensitivity[0]
    slides *= 40.0 / float(slides.square().sum())  # [N] that the margin falls by
    assert bound.share(lin, slides, predicted, at, 2.0) < 1.0
    force = float(at.normal_force(lin).max())  # type: ignore[union-attr]
    grips = [dataclasses.replace(at, grip=force / part) for part in (1.2, 0.75, 0.65, 0.55, 0.3)]
    assert [grip_share(lin, one) for one in grips] == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0])
    assert grip_share(lin, at) == 1.0  # nothing is asked of it
    # a motion that takes the margins away: the heavier the object, the less of it is made
    delta = 4 * DEG * torch.from_numpy(np.sign(lin.margin_sensitivity.sum(0).numpy())) * -1.0
    heavier = [dataclasses.replace(at, weight=weight) for weight in (0.3, 3.0)]
    shares = [bound.share(lin, delta, predicted, one, 10.0) for one in heavier]
    assert 0 < shares[1] < shares[0] < 1


def test_a_measured_grip_that_is_too_weak_is_tightened_and_not_turned(pinch) -> None:
    plant, model, seen = pinch
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    felt = torch.tensor([2.9, 1.4, 1.4, 0.0, 0.0], dtype=torch.float64)
    decision = LookAndMoveController(model, plant.rotation_axis).decide(seen.state, seen.a, target, felt)
    assert 0.0 < float(decision.desired.norm()) < 0.3 * DEG
    change = decision.linearization.normal_force_sensitivity @ decision.delta_a
    assert float(change[0]) > 0.3  # [N]


def test_the_bound_shortens_the_step_that_is_made(pinch) -> None:
    plant, model, seen = pinch
    target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=20.0)
    whole, cut = (
        LookAndMoveController(model, plant.rotation_axis, bound=bound).decide(
            seen.state, seen.a, target, seen.fingertip_force
        )
        for bound in (None, StepBound(off_travel=1e-5))
    )
    size = float(whole.desired.norm()) / (2.5 * DEG)
    torch.testing.assert_close(cut.desired, StepBound().least / size * whole.desired, rtol=1e-6, atol=0)


def test_figures_outside_their_range_are_refused() -> None:
    with pytest.raises(ParameterError, match="creep"):
        StepBound(creep=0.0)
