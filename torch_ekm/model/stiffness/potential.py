"""Potential energy of springs and gravity, its gradient and its second-order terms.

``V(q, p) = 1/2 (q - q0)^T K_s (q - q0) - m g . (o + R c) - sum_l m_l g . x_l(q)``

One convention for everything of second order: the components of the gradient are differentiated
along ``dp = (do, dphi)``, world axes, about the object point ("moving frame"). The blocks are not symmetric
by themselves; their antisymmetric parts cancel in the sum at an equilibrium.
"""

from __future__ import annotations

import torch

from ...kinematics.se3 import hat
from ...typing import Bool, Float, Tensor


def spring_torque(
    q: Float[Tensor, "*batch n_q"], stiffness: Float[Tensor, " n_q"], rest: Float[Tensor, " n_q"]
) -> Float[Tensor, "*batch n_q"]:
    """``V_q = K_s (q - q0)`` [N m]; ``stiffness`` is the diagonal of K_s [N m/rad]."""
    return stiffness * (q - rest)


def gravity_gradient(
    weight: Float[Tensor, " 3"], com_lever: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 6"]:
    """``V_p = [-m g; -r_g x m g]``: minus the gravity wrench about ``o``.

    Args:
        weight: ``m g``, hand frame [N].
        com_lever: ``r_g = R c`` [m].
    """
    weight = weight.expand_as(com_lever)
    return torch.cat([-weight, -torch.linalg.cross(com_lever, weight)], dim=-1)


def gravity_hessian(
    weight: Float[Tensor, " 3"], com_lever: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 6 6"]:
    """``V_pp = blkdiag(0, -[m g]x [r_g]x)``, moving frame, not symmetric."""
    result = torch.zeros(*com_lever.shape[:-1], 6, 6, dtype=com_lever.dtype, device=com_lever.device)
    result[..., 3:, 3:] = -hat(weight) @ hat(com_lever)
    return result


def posture_stiffness(
    force: Float[Tensor, "*batch n_c 3"],
    velocity: Float[Tensor, "*batch n_c n_q 3"],
    axis: Float[Tensor, "*batch n_q 3"],
    precedes: Bool[Tensor, "n_q n_q"],
) -> Float[Tensor, "*batch n_q n_q"]:
    """``S[a, b] = sum_i f_i . (z_a x (z_b x (x_i - o_b)))``, a proximal to b or equal; symmetric [N m/rad].

    How the joint torques that constant forces need change with the posture.

    Args:
        force: ``f_i``, constant in hand axes [N].
        velocity: ``z_b x (x_i - o_b)``, zero where joint b does not move point i [m/rad].
        axis: ``z_a``.
        precedes: joint a is proximal to joint b or equal to it.
    """
    # f.(z_a x v_b) = (f x z_a).v_b, summed over points and components as one product
    turned = torch.linalg.cross(force[..., :, None, :], axis[..., None, :, :])
    upper = turned.mT.flatten(-3, -2).mT @ velocity.mT.flatten(-3, -2) * precedes.to(axis.dtype)
    return upper + upper.mT - torch.diag_embed(upper.diagonal(dim1=-2, dim2=-1))
