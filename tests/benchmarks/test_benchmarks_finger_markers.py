"""Joint angles of a planar hand from markers on its links, from synthetic pictures."""

from __future__ import annotations

import math

import pytest
import torch
from recorded_hand.finger_markers import FingerMarkers

from torch_ekm.description import load_hand
from torch_ekm.kinematics import HandKinematics
from torch_ekm.kinematics.se3 import exp

F64, DEG, NAN = torch.float64, math.pi / 180, math.nan
LINKS = ("left_0", "right_0", "left_1", "right_1")
STD = 3e-4  # [m]


def scene(seed: int) -> tuple[FingerMarkers, torch.Tensor, torch.Tensor]:
    """Markers anywhere on the links, a camera anywhere; random postures and their noisy pictures."""
    generator = torch.Generator().manual_seed(seed)
    hand = load_hand("planar_two_finger")
    kinematics = HandKinematics(hand)
    lower, upper = torch.tensor(hand.joint_lower), torch.tensor(hand.joint_upper)
    q = lower + (upper - lower) * (0.2 + 0.6 * torch.rand(24, hand.n_q, dtype=F64, generator=generator))
    offset = 0.015 + 0.01 * torch.rand(len(LINKS), 3, dtype=F64, generator=generator)  # off the joints
    offset[:, 2] = 0.0
    turn = 2.0 * torch.randn(1, dtype=F64, generator=generator)
    R, t = exp(torch.cat([torch.zeros(2, dtype=F64), turn])), torch.randn(3, dtype=F64, generator=generator)
    poses = kinematics(q).transforms[:, [kinematics.link_index(link) for link in LINKS]]
    x = poses[..., :3, 3] + (poses[..., :3, :3] @ offset[..., None])[..., 0]
    noise = STD * torch.randn(24, len(LINKS), 2, dtype=F64, generator=generator)
    return FingerMarkers(hand, LINKS, offset, R, t, STD), q, (x @ R.mT + t)[..., :2] + noise


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_covariance_is_that_of_the_error(seed: int) -> None:
    markers, q, seen = scene(seed)
    estimate = markers.joints(seen)
    error = (estimate.q - q) / estimate.std
    assert 0.7 < float(error.square().mean().sqrt()) < 1.3
    assert (estimate.q - q).abs().median() < 2 * DEG


def test_a_missing_marker_leaves_its_joint_to_the_prior_and_says_so() -> None:
    markers, _, seen = scene(0)
    hidden = seen[:2].clone()
    hidden[0, 2] = NAN  # the marker of left_1
    estimate = markers.joints(hidden)
    left_1, right_1 = (markers.hand.joint_names.index(name) for name in ("left_1", "right_1"))
    assert estimate.std[0, left_1] > 20 * DEG
    assert estimate.std[1, left_1] < 5 * DEG
    assert estimate.std[0, right_1] < 5 * DEG
    assert torch.allclose(markers.joints(hidden[1]).q, estimate.q[1], atol=1e-9)  # any batch
    assert torch.isfinite(markers.joints(torch.full_like(hidden[0], NAN)).q).all()
