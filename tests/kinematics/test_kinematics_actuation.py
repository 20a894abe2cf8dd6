"""The actuation map: virtual work, couplings, where a free hand rests."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from torch_ekm.description import HandDescription, load_hand
from torch_ekm.exceptions import ShapeError
from torch_ekm.kinematics import ActuationMap
from torch_ekm.kinematics.tensors import null_space

HANDS = ("icub_right", "icub_left", "planar_two_finger")


def rigid(name: str) -> HandDescription:
    """A hand whose drives have no compliance and pull both ways."""
    hand = load_hand(name)
    actuators = (dataclasses.replace(one, stiffness=math.inf, tendon=False) for one in hand.actuators)
    free = np.full(hand.n_q, np.inf)
    return dataclasses.replace(hand, actuators=tuple(actuators), joint_lower=-free, joint_upper=free)


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
def test_joints_invert_actuators_of_rigid_drives(name: str, shape: tuple[int, ...]) -> None:
    """Affine: the least spring energy of all postures with these actuator positions."""
    hand = rigid(name)
    actuation = ActuationMap(hand)
    a = torch.rand(*shape, hand.n_a, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    q = actuation.joints(a)
    assert q.shape == (*shape, hand.n_q)
    torch.testing.assert_close(actuation.actuators(q), a, atol=1e-12, rtol=0)
    slip = torch.from_numpy(hand.coupling) @ (q - torch.from_numpy(hand.spring_rest))[..., None]
    torch.testing.assert_close(slip, torch.zeros_like(slip), atol=1e-12, rtol=0)
    rows = np.vstack([hand.actuation_jacobian, hand.coupling])
    N, K = null_space(rows), np.diag(hand.spring_stiffness)
    P = np.linalg.pinv(rows)[:, : hand.n_a]
    P = P - N @ np.linalg.solve(N.T @ K @ N, N.T @ K @ P) if N.size else P
    excess = (a - actuation.actuators(torch.from_numpy(hand.spring_rest))).numpy()
    torch.testing.assert_close(q, torch.from_numpy(hand.spring_rest + excess @ P.T), atol=1e-12, rtol=0)
    torch.testing.assert_close(
        actuation.free_motion(a)[..., :, :], torch.from_numpy(P).expand(*shape, -1, -1)
    )


@pytest.mark.parametrize("name", HANDS)
def test_free_motion_is_an_equilibrium(name: str) -> None:
    """``K_s (q - q0) = J^T k (a - l)`` along what couplings and stops leave free."""
    hand = load_hand(name)
    actuation = ActuationMap(hand)
    a = torch.from_numpy(0.6 * hand.actuator_lower + 0.4 * hand.actuator_upper).requires_grad_()
    q = actuation.joints(a)
    stretch = (a - actuation.actuators(q)).detach().numpy()
    k = np.array([one.stiffness for one in hand.actuators])
    torque = hand.spring_stiffness * (q.detach().numpy() - hand.spring_rest)
    assert np.abs(torque).max() > 0.01
    q_now = q.detach().numpy()
    stopped = (q_now <= hand.joint_lower + 1e-9) | (q_now >= hand.joint_upper - 1e-9)
    N = null_space(np.vstack([hand.coupling, np.eye(hand.n_q)[stopped]]))
    assert np.abs(N.T @ (torque - (k * stretch) @ hand.actuation_jacobian)).max() < 1e-10
    eye = 1e-6 * torch.eye(hand.n_a, dtype=torch.float64)
    change = (actuation.joints(a + eye) - actuation.joints(a - eye)).detach().T / 2e-6
    torch.testing.assert_close(actuation.free_motion(a), change, atol=1e-8, rtol=0)
    (slope,) = torch.autograd.grad(q.sum(), a)
    torch.testing.assert_close(slope, change.sum(0), atol=1e-8, rtol=0)


def test_errors() -> None:
    actuation = ActuationMap(load_hand("planar_two_finger"))
    with pytest.raises(ShapeError, match="left, right"):
        actuation.joints(torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ShapeError, match="left_0, left_1"):
        actuation.actuators(torch.zeros(2, dtype=torch.float64))
    assert "joints=4" in repr(actuation)
    single = ActuationMap(load_hand("planar_two_finger"), dtype=torch.float32)
    assert single.joints(torch.zeros(2)).dtype == torch.float32
