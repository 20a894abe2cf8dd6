"""What is believed of the object between a reading and what a model expected."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ekm.control import FocusedPose, PoseTarget
from torch_ekm.control.belief import Belief
from torch_ekm.control.decision import Expectation
from torch_ekm.kinematics.se3 import exp
from torch_ekm.plant import Observation

DEG = math.pi / 180
X = torch.eye(3, dtype=torch.float64)[0]
FOCUS, NONE = FocusedPose.rotation_about(X), torch.zeros(0, dtype=torch.float64)


def seen_at(angle: float, variance: float | None = None) -> Observation:
    stated = {} if variance is None else {"pose_covariance": variance * torch.eye(6, dtype=torch.float64)}
    return Observation(NONE, NONE, 0 * X, exp(X * angle * DEG), info={"estimate": stated} if stated else {})


def expecting(angle: float) -> Expectation:
    ds = torch.cat([0 * X, X * angle * DEG])
    return Expectation(NONE, ds, ds, 0 * ds)


def believed(belief: Belief, seen: Observation) -> float:
    return float(FOCUS.matrix @ belief.target(seen).error(seen.state)) / DEG


TARGET = PoseTarget.turned(seen_at(0.0).state, X, degrees=5.0)


def test_a_loop_on_it_follows_less_of_the_noise() -> None:
    noise, draw = 0.15, torch.Generator().manual_seed(0)
    left: dict[bool, list[float]] = {True: [], False: []}
    for filtered in left:
        for _ in range(100):
            angle = 0.0
            belief = Belief(FOCUS, TARGET, seen := seen_at(noise * float(torch.randn(1, generator=draw))))
            for _ in range(6):
                step = 0.8 * max(min(believed(belief, seen), 3.0), -3.0)
                angle += step
                seen = seen_at(angle + noise * float(torch.randn(1, generator=draw)))
                belief.see(seen, expecting(step) if filtered else None)
            left[filtered].append(abs(angle - 5.0))
    filtered, raw = (sum(left[key]) / 100 for key in (True, False))
    assert filtered < 0.8 * raw < 0.1


def test_without_an_expectation_the_target_is_what_was_asked_for() -> None:
    belief = Belief(FOCUS, TARGET, seen_at(0.0))
    belief.see(seen := seen_at(1.3), None)
    assert torch.equal(belief.target(seen).rotation, TARGET.rotation)
    assert torch.equal(belief.target(seen).position, TARGET.position)


def test_an_object_that_slid_is_where_it_is_seen() -> None:
    belief = Belief(FOCUS, TARGET, seen_at(0.0))
    belief.see(near := seen_at(1.2), expecting(1.0))
    assert 3.8 < believed(belief, near) < 4.0
    belief.see(slid := seen_at(4.0), expecting(1.0))
    assert believed(belief, slid) == pytest.approx(1.0)


def test_exact_poses_are_believed() -> None:
    belief = Belief(FOCUS, TARGET, seen_at(0.0))
    belief.see(seen := seen_at(1.2, variance=(1e-3 * DEG) ** 2), expecting(1.0))
    assert believed(belief, seen) == pytest.approx(3.8, abs=1e-3)
