"""Potential energy of springs and gravity, its gradient and its second-order terms.

``V(q, p) = 1/2 (q - q0)^T K_s (q - q0) - m g . (o + R c)``; the weight of the links is left out.

One convention for everything of second order: the components of the gradient are differentiated
along ``dp = (do, dphi)``, world axes, about the object point ("moving frame"). The blocks are not symmetric
by themselves; their antisymmetric parts cancel in the sum at an equilibrium.
"""

from __future__ import annotations

from ..._arrays import like, namespace
from ...kinematics.se3 import cross, hat
from ...typing import AnyArray, Bool, Float, Tensor


def spring_torque(
    q: Float[AnyArray, "*batch n_q"], stiffness: Float[AnyArray, " n_q"], rest: Float[AnyArray, " n_q"]
) -> Float[AnyArray, "*batch n_q"]:
    """``V_q = K_s (q - q0)`` [N m]; ``stiffness`` is the diagonal of K_s [N m/rad]."""
    return stiffness * (q - rest)


def gravity_gradient(
    weight: Float[AnyArray, " 3"], com_lever: Float[AnyArray, "*batch 3"]
) -> Float[AnyArray, "*batch 6"]:
    """``V_p = [-m g; -r_g x m g]``: minus the gravity wrench about ``o``.

    Args:
        weight: ``m g``, hand frame [N].
        com_lever: ``r_g = R c`` [m].
    """
    weight = weight + 0 * com_lever
    return namespace(weight).concat([-weight, cross(weight, com_lever)], -1)


def gravity_hessian(
    weight: Float[AnyArray, " 3"], com_lever: Float[AnyArray, "*batch 3"]
) -> Float[AnyArray, "*batch 6 6"]:
    """``V_pp = blkdiag(0, -[m g]x [r_g]x)``, moving frame, not symmetric."""
    batch, kind = com_lever.shape[:-1], {"dtype": com_lever.dtype, "device": com_lever.device}
    result = namespace(com_lever).zeros((*batch, 6, 6), **kind)
    result[..., 3:, 3:] = -hat(weight) @ hat(com_lever)
    return result


def posture_stiffness(
    force: Float[AnyArray, "*batch n_c 3"],
    velocity: Float[AnyArray, "*batch n_c n_q 3"],
    axis: Float[AnyArray, "*batch n_q 3"],
    precedes: Bool[Tensor, "n_q n_q"],
) -> Float[AnyArray, "*batch n_q n_q"]:
    """``S[a, b] = sum_i f_i . (z_a x (z_b x (x_i - o_b)))``, a proximal to b or equal; symmetric [N m/rad].

    How the joint torques that constant forces need change with the posture.

    Args:
        force: ``f_i``, constant in hand axes [N].
        velocity: ``z_b x (x_i - o_b)``, zero where joint b does not move point i [m/rad].
        axis: ``z_a``.
        precedes: joint a is proximal to joint b or equal to it.
    """
    # f.(z_a x v_b) = (f x z_a).v_b, summed over points and components as one product
    turned = cross(force[..., :, None, :], axis[..., None, :, :]).mT
    turned, v = (x.reshape(*x.shape[:-3], -1, x.shape[-1]) for x in (turned, velocity.mT))
    upper = turned.mT @ v * like(precedes, axis)
    return upper + upper.mT * ~namespace(axis).eye(upper.shape[-1], dtype=bool, device=axis.device)
