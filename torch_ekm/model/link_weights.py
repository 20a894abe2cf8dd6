"""The weight of the hand's own links."""

from __future__ import annotations

import torch
from torch import nn

from ..description.hand import HandDescription
from ..typing import Float, Tensor
from .potential import link_weight_terms
from .stiffness import precedence


class LinkWeights(nn.Module):
    """``V = -sum_l m_l g . x_l(q)``: gradient [N m] and Hessian [N m/rad] over the joints.

    Masses and centres of mass are those of the hand's URDF.

    Args:
        hand: gives the URDF.
        kinematics: of the same hand.
        gravity: g in the hand frame [m/s^2].
        dtype: of the buffers.
    """

    def __init__(
        self,
        hand: HandDescription,
        kinematics: nn.Module,
        gravity: tuple[float, float, float],
        dtype: torch.dtype,
    ) -> None:
        super().__init__()
        upstream: Tensor = kinematics.upstream  # type: ignore[assignment]
        names = list(kinematics.link_names)  # type: ignore[arg-type]
        links = [link for link in hand.urdf.links if link.mass > 0 and upstream[names.index(link.name)].any()]
        self.kinematics_joint_axes = kinematics.joint_axes
        self.index = [names.index(link.name) for link in links]
        mass = torch.tensor([link.mass for link in links], dtype=dtype)
        self.weights: Tensor
        self.com: Tensor
        self.upstream: Tensor
        self.precedes: Tensor
        self.register_buffer("weights", mass[:, None] * torch.tensor(gravity, dtype=dtype), persistent=False)
        com = torch.stack([torch.as_tensor(link.com).to(dtype) for link in links])
        self.register_buffer("com", com, persistent=False)
        self.register_buffer("upstream", upstream[self.index], persistent=False)
        self.register_buffer("precedes", precedence(upstream), persistent=False)

    def forward(self, poses) -> tuple[Float[Tensor, "*batch n_q"], Float[Tensor, "*batch n_q n_q"]]:
        """Gradient and Hessian at the link poses of a posture."""
        T = poses.transforms[..., self.index, :, :]
        centre = T[..., :3, 3] + (T[..., :3, :3] @ self.com[..., None])[..., 0]
        axis, origin = self.kinematics_joint_axes(poses)  # type: ignore[operator]
        return link_weight_terms(self.weights, centre, axis, origin, self.upstream, self.precedes)
