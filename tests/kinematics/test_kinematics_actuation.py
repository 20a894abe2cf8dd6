"""The actuation map: virtual work, couplings, the free-motion inverse."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ekm.description import load_hand
from torch_ekm.exceptions import ShapeError
from torch_ekm.kinematics import ActuationMap

HANDS = ("icub_right", "icub_left", "planar_two_finger")


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
def test_joints_invert_actuators(name: str, shape: tuple[int, ...]) -> None:
    hand = load_hand(name)
    actuation = ActuationMap(hand)
    a = torch.rand(*shape, hand.n_a, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    q = actuation.joints(a)
    assert q.shape == (*shape, hand.n_q)
    torch.testing.assert_close(actuation.actuators(q), a, atol=1e-12, rtol=0)
    slip = actuation.C @ (q - torch.from_numpy(hand.spring_rest))[..., None]
    torch.testing.assert_close(slip, torch.zeros_like(slip), atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", HANDS)
def test_free_motion_is_an_equilibrium_of_the_springs(name: str) -> None:
    """Virtual work: ``K_s (q - q0)`` does none along motions that actuators and couplings leave free."""
    hand = load_hand(name)
    actuation = ActuationMap(hand)
    a = torch.linspace(0.1, 1.0, hand.n_a, dtype=torch.float64)
    q = actuation.joints(a)
    torque = torch.from_numpy(hand.spring_stiffness) * (q - torch.from_numpy(hand.spring_rest))
    assert float(torque.abs().max()) > 0.01
    assert float((actuation.null.mT @ torque).abs().max()) < 1e-12
    for rows in (actuation.J_a, actuation.C):
        assert float((rows @ actuation.null).abs().sum()) < 1e-11


def test_icub_splits_evenly() -> None:
    """a/2 per distal joint, a/3 per ring or little joint, (60 deg - a)/3 per abduction: iKin's split."""
    hand = load_hand("icub_right")
    actuation = ActuationMap(hand)
    a_deg = {
        "hand_finger": 33.0,
        "thumb_oppose": 40.0,
        "thumb_distal": 50.0,
        "index_distal": 70.0,
        "pinky": 90.0,
    }
    a = torch.tensor(
        [math.radians(a_deg.get(name, 0.0)) for name in hand.actuator_names], dtype=torch.float64
    )
    q = dict(zip(hand.joint_names, torch.rad2deg(actuation.joints(a)).tolist(), strict=True))
    expected = {
        "thumb_0": 40.0,
        "thumb_1": 0.0,
        "thumb_2": 25.0,
        "thumb_3": 25.0,
        "index_2": 35.0,
        "index_3": 35.0,
    }
    expected |= {f"{finger}_{k}": 30.0 for finger in ("ring", "little") for k in (1, 2, 3)}
    expected |= {f"{finger}_0": 9.0 for finger in ("index", "ring", "little")} | {"middle_0": 0.0}
    for joint, angle in expected.items():
        assert q[joint] == pytest.approx(angle, abs=1e-9), joint


def test_icub_counts() -> None:
    """9 actuators + 4 couplings leave 7 of 20 joints to springs and contacts."""
    actuation = ActuationMap(load_hand("icub_right"))
    assert actuation.J_a.shape == (9, 20)
    assert actuation.C.shape == (4, 20)
    assert actuation.null.shape == (20, 7)
    assert torch.linalg.matrix_rank(torch.cat([actuation.J_a, actuation.C])) == 13
    # hand_finger: 60 deg together, 0 deg spread by 20 deg each
    q = torch.zeros(20, dtype=torch.float64)
    assert math.degrees(float(actuation.actuators(q)[0])) == pytest.approx(60.0)
    q[[4, 12, 16]] = math.radians(20)
    assert math.degrees(float(actuation.actuators(q)[0])) == pytest.approx(0.0, abs=1e-9)


def test_planar_by_hand() -> None:
    """Springs 0.2 and 0.1, arms 1 and 0.8: ``q = a K^-1 J^T/(J K^-1 J^T) = a (5, 8)/11.4``."""
    actuation = ActuationMap(load_hand("planar_two_finger"), dtype=torch.float32)
    q = actuation.joints(torch.tensor([1.14, 0.57]))
    torch.testing.assert_close(q, torch.tensor([0.5, 0.8, 0.25, 0.4]))


def test_errors() -> None:
    actuation = ActuationMap(load_hand("planar_two_finger"))
    with pytest.raises(ShapeError, match="left, right"):
        actuation.joints(torch.zeros(3, dtype=torch.float64))
    with pytest.raises(ShapeError, match="left_0, left_1"):
        actuation.actuators(torch.zeros(2, dtype=torch.float64))
    assert "free=2" in repr(actuation)
