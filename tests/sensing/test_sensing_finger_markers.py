"""Markers on the fingers: their places, the camera's, and the joint angles, from synthetic pictures."""

from __future__ import annotations

import functools
import math

import pytest
import torch

from torch_ekm.description import load_hand
from torch_ekm.exceptions import CalibrationError, ParameterError, ShapeError, UnknownNameError
from torch_ekm.kinematics import HandKinematics
from torch_ekm.kinematics.se3 import exp
from torch_ekm.sensing import calibrate_markers

F64, DEG, NAN = torch.float64, math.pi / 180, math.nan
LINKS = {
    "planar_two_finger": ["left_0", "right_0", "left_1", "right_1"],
    "icub_right": ["thumb_1", "thumb_2", "thumb_3", "thumb_3", "index_1", "index_2", "index_3", "index_3"],
}
STD = 3e-4


@functools.lru_cache
def scene(name, seed, frames=24, turn=2.0):
    """Random postures of a hand, markers anywhere on the links, a camera anywhere; noise of 0.3 mm."""
    generator = torch.Generator().manual_seed(seed)
    hand, links = load_hand(name), LINKS[name]
    kinematics = HandKinematics(hand)
    lower, upper = torch.tensor(hand.joint_lower), torch.tensor(hand.joint_upper)
    q = lower + (upper - lower) * (0.2 + 0.6 * torch.rand(frames, hand.n_q, dtype=F64, generator=generator))
    C, rest = torch.tensor(hand.coupling), torch.tensor(hand.spring_rest)
    q = q - (q - rest) @ C.mT @ torch.linalg.pinv(C).mT if len(C) else q
    offset = 0.015 + 0.01 * torch.rand(len(links), 3, dtype=F64, generator=generator)  # away from the joints
    d = 2 if hand.planar_normal else 3
    phi = turn * torch.randn(3, dtype=F64, generator=generator)
    if d == 2:
        offset[:, 2], phi[:2] = 0.0, 0.0  # in the plane
    R, t = exp(phi), torch.randn(3, dtype=F64, generator=generator)
    poses = kinematics(q).transforms[:, [kinematics.link_index(link) for link in links]]
    x = poses[..., :3, 3] + (poses[..., :3, :3] @ offset[..., None])[..., 0]
    noise = STD * torch.randn(frames, len(links), d, dtype=F64, generator=generator)
    return hand, links, q, offset, (x @ R.mT + t)[..., :d] + noise, R


def some(q, frames):
    known = torch.full_like(q, NAN)
    known[:frames] = q[:frames]
    return known


@pytest.mark.parametrize("name", list(LINKS))
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_places_camera_and_angles_are_found_within_their_standard_errors(name, seed):
    hand, links, q, offset, seen, R = scene(name, seed)
    seen = seen.clone()
    seen[4, 2], seen[6:9, 3] = NAN, NAN  # hidden now and then
    fit = calibrate_markers(hand, links, seen, q=some(q, 4), q_std=0.005, marker_std=STD)
    assert fit.offset_std.max() < 2e-3
    assert ((fit.offset - offset).norm(dim=-1) < 5 * fit.offset_std + 1e-5).all()
    assert (fit.rotation @ R.mT).diagonal().sum() > 1 + 2 * math.cos(5 * float(fit.registration_std[0]))
    assert 0.75 * STD < fit.noise < 1.25 * STD
    estimate = fit.joints(seen)
    moved = [
        k for k in range(hand.n_q) if hand.joint_names[k].split("_")[0] in {n.split("_")[0] for n in links}
    ]
    whole = torch.isfinite(seen).flatten(1).all(1)
    error = ((estimate.q - q) / estimate.std)[whole][:, moved]
    assert 0.6 < float(error.square().mean().sqrt()) < 1.8  # the covariance tells the error
    assert (estimate.q - q)[whole][:, moved].abs().median() < 2 * DEG


def test_a_missing_marker_leaves_its_joint_to_the_prior_and_says_so():
    hand, links, q, _, seen, *_ = scene("planar_two_finger", 0)
    fit = calibrate_markers(hand, links, seen, q=some(q, 4), marker_std=STD)
    hidden = seen[:2].clone()
    hidden[0, 2] = NAN  # the marker of left_1
    estimate = fit.joints(hidden)
    left_1 = hand.joint_names.index("left_1")
    assert estimate.std[0, left_1] > 20 * DEG
    assert estimate.std[1, left_1] < 5 * DEG
    assert estimate.std[0, hand.joint_names.index("right_1")] < 5 * DEG
    assert torch.allclose(fit.joints(hidden[1]).q, estimate.q[1], atol=1e-9)  # any batch
    nothing = fit.joints(torch.full_like(hidden[0], NAN))
    assert torch.isfinite(nothing.q).all()


def test_another_recording_needs_its_camera_only():
    hand, links, q, offset, seen, *_ = scene("planar_two_finger", 1)
    fit = calibrate_markers(hand, links, seen, q=some(q, 4), marker_std=STD)
    shift, turned = torch.tensor([0.007, -0.003], dtype=F64), exp(torch.tensor([0.0, 0.0, 0.1], dtype=F64))
    other = (seen @ turned[:2, :2].mT + shift)[12:]
    again = fit.registered(other)
    assert torch.allclose(again.rotation, turned @ fit.rotation, atol=0.03)
    assert (again.offset - offset).abs().max() < 1e-3
    assert (again.joints(other).q - fit.joints(seen[12:]).q).abs().median() < 1 * DEG
    assert fit.joints(other).q.sub(q[12:]).abs().median() > 4 * DEG  # with the old camera


def test_what_markers_cannot_tell_is_refused():
    hand, links, q, _, seen, *_ = scene("planar_two_finger", 2)
    with pytest.raises(
        CalibrationError, match="left_1"
    ):  # the zero of a last joint is its marker's direction
        calibrate_markers(hand, links, seen)
    with pytest.raises(CalibrationError, match="seen"):
        calibrate_markers(hand, links, seen * NAN, q=q)


def test_bad_input_is_named():
    hand, links, q, _, seen, *_ = scene("planar_two_finger", 2)
    with pytest.raises(ShapeError, match="seen"):
        calibrate_markers(hand, links, seen[:, :3])
    with pytest.raises(ShapeError, match="q must"):
        calibrate_markers(hand, links, seen, q=q[:3])
    with pytest.raises(UnknownNameError, match="middle_1"):
        calibrate_markers(hand, ["middle_1"] * 4, seen)
    with pytest.raises(ParameterError, match="marker_std"):
        calibrate_markers(hand, links, seen, marker_std=0.0)
