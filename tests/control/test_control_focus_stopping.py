"""Focused pose, targets and the stopping rule."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ekm.control import FocusedPose, PoseTarget, StoppingRule, StopReason
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError
from torch_ekm.kinematics.grasp_state import GraspState
from torch_ekm.kinematics.se3 import exp

AXIS = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)


def state(generator: torch.Generator) -> GraspState:
    draw = lambda n: torch.randn(n, generator=generator, dtype=torch.float64)  # noqa: E731
    return GraspState(draw(4), draw(3), exp(draw(3)))


def test_error_of_a_turned_pose_is_the_turn(generator: torch.Generator) -> None:
    start = state(generator)
    target = PoseTarget.turned(start, 3 * AXIS, 0.4)
    expected = torch.cat([torch.zeros(3, dtype=torch.float64), 0.4 * AXIS])
    torch.testing.assert_close(target.error(start), expected)
    there = start.plus(torch.cat([torch.zeros(4, dtype=torch.float64), expected]))
    torch.testing.assert_close(target.error(there), torch.zeros(6, dtype=torch.float64), atol=1e-12, rtol=0)


def test_focus_and_rest_span_all_directions() -> None:
    focus = FocusedPose.rotation_about(AXIS)
    rows = torch.cat([focus.matrix, focus.off_matrix])
    assert rows.shape == (6, 6)
    torch.testing.assert_close(rows @ rows.mT, torch.eye(6, dtype=torch.float64))
    assert len(focus.matrix) == 1
    assert focus.off_translation.tolist() == [True] * 3 + [False] * 2


@pytest.mark.usefixtures("unchecked")
def test_bad_focus_is_refused() -> None:
    with pytest.raises(ShapeError):
        FocusedPose(torch.eye(5, dtype=torch.float64))
    with pytest.raises(ParameterError, match="orthonormal"):
        FocusedPose(2 * torch.eye(6, dtype=torch.float64)[:1])
    with pytest.raises(ParameterError, match="non-zero"):
        FocusedPose.rotation_about(torch.zeros(3, dtype=torch.float64))
    with pytest.raises(NonFiniteError, match="angle"):
        PoseTarget.turned(state(torch.Generator().manual_seed(0)), AXIS, math.nan)


RULE = StoppingRule(tolerance=0.1, stall_window=3, stall_progress=0.05, max_steps=10)


@pytest.mark.parametrize(
    ("errors", "limited", "reason"),
    [
        ([1.0], False, StopReason.RUNNING),
        ([1.0, 0.05], False, StopReason.RUNNING),  # looks decide on that
        ([1.0, 0.5, 0.49, 0.51, 0.5], False, StopReason.STALLED),
        ([1.0, 0.5, 0.49, 0.51, 0.5], True, StopReason.ACTUATOR_LIMITS),
        ([1.0, 0.8, 0.6, 0.4, 0.3], False, StopReason.RUNNING),
        ([3.0 - 0.1 * k for k in range(11)], False, StopReason.STEP_LIMIT),
    ],
)
def test_stopping_rule(errors: list[float], limited: bool, reason: StopReason) -> None:
    assert RULE.judge(errors, limited) is reason


def test_stopping_rule_refuses_nonsense() -> None:
    with pytest.raises(ParameterError, match="max_steps"):
        StoppingRule(tolerance=0.1, max_steps=0)
