"""The URDF's fingers against the robot's own kinematic library.

iKin is written down here a second time and from the other end: its denavit-hartenberg figures as they
stand in robotology/icub-main (commit 24c1a0030, src/libraries/iKin/src/iKinFwd.cpp,
iCubFinger::allocate, right hand, thumb version b; BSD-3-Clause) and in icub-tech-iit/documentation
(icub-forward-kinematics-fingers.md). iKin counts the abduction angle from the spread pose, has a dummy
second link in the thumb and no abduction in the middle finger.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torch_ekm.description import load_hand
from torch_ekm.kinematics import HandKinematics

POSTURES = 1000

H0 = {
    "thumb": [
        [0.478469, 0.063689, -0.875792, -0.024029759],
        [-0.878095, 0.039246, -0.476873, -0.01193433],
        [0.004, 0.997198, 0.074703, -0.00168926],
    ],
    "index": [
        [0.898138, 0.439714, 0.0, 0.00245549],
        [-0.43804, 0.89472, 0.087156, -0.025320433],
        [0.038324, -0.078278, 0.996195, -0.010973325],
    ],
    "middle": [[1.0, 0.0, 0.0, 0.0178], [0.0, 0.0, -1.0, -0.00830233], [0.0, 1.0, 0.0, -0.0118]],
    "ring": [
        [0.9998, 0.0192, 0.0, 0.00156923],
        [0.0191, -0.996, 0.0872, 0.007158757],
        [0.0017, -0.0871, -0.9962, -0.011458935],
    ],
    "little": [
        [0.9998, 0.0192, 0.0, -0.00042147],
        [0.0191, -0.996, 0.0872, 0.0232755],
        [0.0017, -0.0871, -0.9962, -0.00956329],
    ],
}
# a [m], d [m], alpha [deg], offset [deg] of each link
LINKS = {
    "thumb": [(0, 0, -90, 0), (0.021, 0.0056, 0, 0), (0.026, 0, 0, 0), (0.022, 0, 0, 0), (0.0168, 0, -90, 0)],
    "index": [(0.0148, 0, 90, 0), (0.0259, 0, 0, 0), (0.022, 0, 0, 0), (0.0168, 0, -90, 0)],
    "middle": [(0.0285, 0, 0, 0), (0.024, 0, 0, 0), (0.0168, 0, -90, 0)],
    "ring": [(0.0148, 0, -90, -20), (0.0259, 0, 0, 0), (0.022, 0, 0, 0), (0.0168, 0, -90, 0)],
    "little": [(0.0148, 0, -90, -20), (0.0219, 0, 0, 0), (0.019, 0, 0, 0), (0.0168, 0, -90, 0)],
}
SPREAD = math.radians(20)


def ikin_angles(finger: str, q: np.ndarray) -> np.ndarray:
    """Our four joint angles of a finger -> the angles of iKin's links."""
    if finger == "thumb":
        return np.array([q[0], 0.0, q[1], q[2], q[3]])
    if finger == "middle":
        return q[1:]
    return np.array([SPREAD - q[0], *q[1:]])


def ikin_tip(finger: str, angles: np.ndarray) -> np.ndarray:
    """``T = H0 prod Rz(theta + offset) Tz(d) Tx(a) Rx(alpha)``"""
    T = np.vstack([H0[finger], [0, 0, 0, 1]])
    for (a, d, alpha_deg, offset_deg), angle in zip(LINKS[finger], angles, strict=True):
        c, s = math.cos(angle + math.radians(offset_deg)), math.sin(angle + math.radians(offset_deg))
        ca, sa = math.cos(math.radians(alpha_deg)), math.sin(math.radians(alpha_deg))
        T = T @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
    return T


@pytest.mark.parametrize("finger", list(LINKS))
def test_fingertips_are_where_ikin_says(finger: str) -> None:
    hand = load_hand("icub_right")
    rng = np.random.default_rng(11)
    q = hand.joint_lower + rng.random((POSTURES, hand.n_q)) * (hand.joint_upper - hand.joint_lower)
    ours = HandKinematics(hand)(torch.from_numpy(q)).of(f"{finger}_tip").numpy()
    first = hand.joint_names.index(f"{finger}_0")
    theirs = np.stack([ikin_tip(finger, ikin_angles(finger, row[first : first + 4])) for row in q])
    assert np.abs(ours[:, :3, 3] - theirs[:, :3, 3]).max() < 1e-5
    # iKin prints H0 with 4 to 6 digits, so its rotations are orthonormal to 1e-4 only
    assert np.abs(ours[:, :3, :3] - theirs[:, :3, :3]).max() < 2e-4


def test_the_left_hand_is_the_mirror_image() -> None:
    """``p_left = M p_right``, ``R_left = M R_right D`` M the reflection of y, D that of one link axis."""
    right, left = load_hand("icub_right"), load_hand("icub_left")
    assert right.joint_names == left.joint_names
    rng = np.random.default_rng(12)
    q = right.joint_lower + rng.random((50, 20)) * (right.joint_upper - right.joint_lower)
    T_right, T_left = (HandKinematics(hand)(torch.from_numpy(q)).transforms for hand in (right, left))
    M = torch.diag(torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(T_left[..., :3, 3], T_right[..., :3, 3] @ M, atol=1e-9, rtol=0)
    D = T_right[..., :3, :3].mT @ M @ T_left[..., :3, :3]
    kinds = torch.stack(
        [torch.diag(torch.tensor(d, dtype=torch.float64)) for d in ((1.0, -1, 1), (1.0, 1, -1))]
    )
    assert bool(((D[..., None, :, :] - kinds).abs().amax((-1, -2)) < 1e-9).any(-1).all())
