"""Joint angles from markers on the fingers whose places are known, and the camera's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torch_ekm.description import HandDescription
from torch_ekm.kinematics import HandKinematics
from torch_ekm.sensing.joint_estimator import COUPLING_STD, JointEstimate
from torch_ekm.typing import Float, Tensor

_ITERATIONS = 20  # of Gauss-Newton, for all frames


@dataclass(frozen=True)
class FingerMarkers:
    """``y_m = R x_m(q) + t``, ``x_m`` the point ``offset_m`` of the marker's link: of a planar hand,
    seen in two coordinates whose axes turn from the first to the second as joints do about ``planar_normal``.
    """

    hand: HandDescription
    link: tuple[str, ...]
    """Of each marker."""
    offset: Float[Tensor, "n_m 3"]
    """In the link's frame [m]; in a planar hand in its plane."""
    rotation: Float[Tensor, "3 3"]
    """R, hand axes to the camera's."""
    translation: Float[Tensor, " 3"]
    """t [m]."""
    noise: float
    """Standard deviation of a marker's coordinate [m]."""

    def joints(self, seen: Float[Tensor, "*batch n_m 2"]) -> JointEstimate:
        """``min_q sum_m |R x_m(q) + t - y_m|^2 / sigma^2 + |(q - middle)/spread|^2`` by Gauss-Newton.

        A weak prior, uniform over each joint's range, stands in where markers are missing, and the covariance
        says so. It counts the noise of the markers, not the calibration's errors, which all frames share.

        Args:
            seen: in the plane of the picture [m]; NaN: not seen.
        """
        kinematics = HandKinematics(self.hand)
        index = [kinematics.link_index(name) for name in self.link]
        flat = seen.to(torch.float64).reshape(-1, len(index), 2)
        visible = torch.isfinite(flat)
        weight = visible.to(flat.dtype) / self.noise**2
        middle, spread, rest, C = _joint_prior(self.hand)
        fixed = torch.diag(spread**-2) + C.mT @ C / COUPLING_STD**2
        q = middle.expand(len(flat), -1)
        for _ in range(_ITERATIONS):
            poses = kinematics(q)
            T = poses.transforms[..., index, :, :]
            x = T[..., :3, 3] + (T[..., :3, :3] @ self.offset[..., None])[..., 0]
            J_q = [kinematics.jacobian(poses, k, self.offset[m])[..., :3, :] for m, k in enumerate(index)]
            J = (self.rotation @ torch.stack(J_q, dim=-3))[..., :2, :].flatten(1, 2)
            miss = (flat - (x @ self.rotation.mT + self.translation)[..., :2]).nan_to_num().flatten(1)
            J_w = (weight.flatten(1)[..., None] * J).mT
            information = J_w @ J + fixed
            coupled = (rest - q) @ C.mT @ C / COUPLING_STD**2
            right = (J_w @ miss[..., None])[..., 0] + (middle - q) / spread**2 + coupled
            q = q + torch.linalg.solve(information, right).clamp(-0.5, 0.5)
        covariance = torch.linalg.inv(information)
        return JointEstimate(*(x.reshape(*seen.shape[:-2], *x.shape[1:]) for x in (q, covariance)))


def _joint_prior(hand: HandDescription) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Middle and standard deviation of the joints' ranges; q0 and C of the couplings ``C q = C q0``."""
    given = (hand.joint_lower, hand.joint_upper, hand.spring_rest, hand.coupling)
    lower, upper, rest, C = (torch.from_numpy(x.copy()) for x in given)
    lower, upper = lower.clamp(min=-math.pi), upper.clamp(max=math.pi)
    return (lower + upper) / 2, (upper - lower).clamp(min=1e-3) / math.sqrt(12), rest, C
