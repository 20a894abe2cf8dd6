"""The weight of the hand's own links."""

from __future__ import annotations

import torch
from torch import nn

from torch_ekm.description.hand import HandDescription
from torch_ekm.kinematics.link_poses import Kinematics, LinkPoses
from torch_ekm.model.stiffness.geometric import precedence
from torch_ekm.model.stiffness.potential import posture_stiffness
from torch_ekm.typing import Float, Tensor


class LinkWeights(nn.Module):
    """``V = -sum_l m_l g . x_l(q)``: gradient ``-sum_l J_l^T m_l g`` [N m] and Hessian [N m/rad].

    Args:
        hand: its URDF gives masses and centres of mass.
        kinematics: of the same hand.
    """

    def __init__(self, hand: HandDescription, kinematics: Kinematics) -> None:
        super().__init__()
        dtype = kinematics.dtype
        upstream, names = kinematics.upstream, list(kinematics.link_names)
        links = [link for link in hand.urdf.links if link.mass > 0 and upstream[names.index(link.name)].any()]
        self._joint_axes, self._index = kinematics.joint_axes, [names.index(link.name) for link in links]
        mass = torch.tensor([link.mass for link in links], dtype=dtype)
        com = torch.stack([torch.as_tensor(link.com).to(dtype) for link in links])
        g = torch.tensor(hand.gravity, dtype=dtype)
        self.weights = nn.Buffer(mass[:, None] * g, persistent=False)  # m_l g [N], (n_l, 3)
        self.com = nn.Buffer(com, persistent=False)  # in the links' frames [m], (n_l, 3)
        self.upstream = nn.Buffer(upstream[self._index], persistent=False)
        self.precedes = nn.Buffer(precedence(upstream), persistent=False)

    def forward(
        self, poses: LinkPoses
    ) -> tuple[Float[Tensor, "*batch n_q"], Float[Tensor, "*batch n_q n_q"]]:
        """Gradient and Hessian at the link poses of a posture."""
        T = poses.transforms[..., self._index, :, :]
        centre = T[..., :3, 3] + (T[..., :3, :3] @ self.com[..., None])[..., 0]
        axis, origin = self._joint_axes(poses)
        velocity = torch.linalg.cross(
            axis[..., None, :, :] * self.upstream[..., None].to(axis.dtype),
            centre[..., :, None, :] - origin[..., None, :, :],
        )
        gradient = -torch.einsum("lk,...ljk->...j", self.weights, velocity)
        return gradient, posture_stiffness(-self.weights.expand_as(centre), velocity, axis, self.precedes)
