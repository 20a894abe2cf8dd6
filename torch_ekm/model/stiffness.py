"""The stiffness of a grasp: curvature of tendons and loops over the posture, of contacts, of gravity."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch

from .._arrays import eye, like, namespace, zeros
from ..contact.contacts import ContactKinematics
from ..description.hand import HandDescription
from ..kinematics.se3 import cross, hat
from ..typing import AnyArray, Array, Bool, Float, Tensor


class Arms(NamedTuple):
    """Of one posture, or a batch; None: nothing changes, there are no loops."""

    ratio: Float[AnyArray, "*batch n_a n_q"] | None = None
    """Moment arms as factors of those of the description."""
    closed: Float[AnyArray, "*batch n_l n_q"] | None = None
    """dc/dq of the loops."""

    def of(self, actuation: Float[AnyArray, "*rows n_a n_q"]) -> Any:
        """Moment arms at the posture."""
        return actuation if self.ratio is None else actuation * like(torch.as_tensor(self.ratio), actuation)

    @property
    def varies(self) -> bool:
        return self.ratio is not None or self.closed is not None

    def one(self, k: int) -> Arms:
        """Of a state of a flat batch."""
        return Arms(*(None if part is None else part.reshape(-1, *part.shape[-2:])[k] for part in self))


SAME = Arms()
"""Those of the description."""


def arms_at(hand: HandDescription, q: Float[AnyArray, "*batch n_q"]) -> Arms:
    """At a posture."""
    lengths, loops = hand.lengths, hand.loops
    ratio = None if lengths.constant else over_posture(q, lengths.ratio)
    return Arms(ratio, None if loops is None else over_posture(q, loops.lengths.jacobian))


def bends(
    hand: HandDescription,
    q: Float[AnyArray, "*batch n_q"],
    actuation: Float[AnyArray, "n_a n_q"],
    lam: Float[AnyArray, "*batch n_a"],
    loop: Float[AnyArray, "*batch n_l"],
) -> Any:
    """``sum_i lam_i d2l_i/dq2 + sum_k nu_k d2c_k/dq2`` ``(*batch, n_q, n_q)``; 0 where no arm changes.

    ``actuation`` is J_a of the description, ``loop`` nu, the forces of the loops.
    """
    parts = [] if hand.lengths.constant else [(hand.lengths, lam, actuation)]
    if hand.loops is not None and loop.shape[-1]:
        typical = like(torch.from_numpy(hand.loops.lengths.typical).to(torch.as_tensor(q)), q)
        parts.append((hand.loops.lengths, loop, typical))
    total: Any = 0.0
    for lengths, force, arms in parts:
        D = namespace(q).einsum("...i,ij,...ijk->...jk", force, arms, over_posture(q, lengths.slope))
        total = total + (D + D.mT) / 2
    return total


def over_posture(q: AnyArray, function: Callable[[Array], Array]) -> Any:
    """A function of the posture, in tensors where q is one."""
    if not isinstance(q, Tensor):
        return function(q)
    return torch.from_numpy(function(q.double().cpu().numpy())).to(q)


def geometric_stiffness(
    kin: ContactKinematics,
    force: Float[AnyArray, "*batch n_c 3"],
    spin_moment: Float[AnyArray, "*batch n_c"],
    precedes: Bool[Tensor, "n_q n_q"],
) -> Float[AnyArray, "*batch n_s n_s"]:
    """``dF/ds`` at constant contact forces: hand part S, object part T, rolling and soft-finger spin.

    ```
      sum_i blkdiag(S_i + W_i, 0, -[f_i]x [r_i]x)
    + sum_i Omega_i^T [f_i]x M_i [n_i]x Omega_i                                   rolling, M = (K_f + K_o)^+
    + sum_i Omega_i^T (-[m_i]x Omega_o + mu_4i K_o,i M_i [n_i]x Omega_i)          soft finger
    S_i[a, b] = f_i . (z_a x (z_b x (x_i - o_b)))    a proximal to b or equal, symmetric
    W_i[a, b] = (z_b x z_a) . m_i                    b strictly proximal to a, else 0
    ```

    Not symmetric for rolling or soft fingers in space, where the contacts are not holonomic.

    Args:
        kin: the contacts.
        force: ``f_i`` of the finger on the object, hand axes [N], held constant there.
        spin_moment: ``mu_4i`` about the inward normal [N m], held constant about the moving normal.
        precedes: ``[a, b]``: joint a is proximal to joint b on the same branch, or equal to it.
    """
    n_q = kin.axis.shape[-2]
    D = zeros(force, *force.shape[:-2], n_q + 6, n_q + 6)
    f_hat = hat(force)
    D[..., :n_q, :n_q] = posture_stiffness(force, kin.point_jacobian.mT, kin.axis, precedes)
    D[..., n_q + 3 :, n_q + 3 :] = -(f_hat @ hat(kin.lever)).sum(-3)
    Omega = kin.relative_spin
    D = D + _over_contacts(Omega, (f_hat @ kin.roll) @ Omega)
    if bool((spin_moment != 0).any()):
        D = D + _spin_terms(kin, spin_moment, precedes)
    return D


def _over_contacts(left: AnyArray, right: AnyArray) -> Any:
    """``sum_i left_i^T right_i`` as one product."""
    left, right = (x.reshape(*x.shape[:-3], -1, x.shape[-1]) for x in (left, right))
    return left.mT @ right


def _spin_terms(kin: ContactKinematics, spin_moment: AnyArray, precedes: Tensor) -> Any:
    n_q, Omega = kin.axis.shape[-2], kin.relative_spin
    moment = -kin.contacts.normal * spin_moment[..., None]
    inner = 0 * Omega
    inner[..., n_q + 3 :] = -hat(moment)
    inner = inner + spin_moment[..., None, None] * (kin.contacts.object_curvature @ kin.roll @ Omega)
    D = _over_contacts(Omega, inner)
    # (z_b x z_a) . m = z_a . (m x z_b), for b strictly proximal to a, both upstream of the contact
    J_w = kin.spin_jacobian
    W = _over_contacts(J_w, hat(moment) @ J_w)
    precedes = like(precedes, W)
    D[..., :n_q, :n_q] += W * (precedes & ~precedes.mT).mT
    return D


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
    result = zeros(com_lever, *com_lever.shape[:-1], 6, 6)
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
        precedes: as of :func:`geometric_stiffness`.
    """
    # f.(z_a x v_b) = (f x z_a).v_b, summed over points and components as one product
    turned = cross(force[..., :, None, :], axis[..., None, :, :]).mT
    turned, v = (x.reshape(*x.shape[:-3], -1, x.shape[-1]) for x in (turned, velocity.mT))
    upper = turned.mT @ v * like(precedes, axis)
    return upper + upper.mT * (1 - eye(axis, upper.shape[-1]))
