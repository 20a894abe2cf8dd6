"""How contact points move with the joints and the object: everything about a contact that the model needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch

from ..kinematics.se3 import hat
from ..typing import Bool, Float, Tensor
from .contact_model import ContactModel, contact_models, selected_rows
from .contact_set import ContactSet

FLAT = 1.0
"""Curvature [1/m] below which a direction counts as flat: a radius above 1 m."""


@dataclass(frozen=True)
class ContactKinematics:
    """Geometry of ``n_c`` contacts at one state (or a batch), hand frame."""

    contacts: ContactSet
    models: tuple[ContactModel, ...]
    frame: Float[Tensor, "*batch n_c 3 3"]
    """C_i: columns ``n_in = -n``, ``t1``, ``t2``."""
    lever: Float[Tensor, "*batch n_c 3"]
    """r_i = x_i - o [m]."""
    axis: Float[Tensor, "*batch n_q 3"]
    """z_j, unit vectors along the joint axes, hand frame."""
    point_jacobian: Float[Tensor, "*batch n_c 3 n_q"]
    """Velocity of the finger's material point at x_i [m/rad]."""
    spin_jacobian: Float[Tensor, "*batch n_c 3 n_q"]
    """Angular velocity of the finger link."""
    mobility: Float[Tensor, "*batch n_c 3 3"]
    """(K_f + K_o)^+ in the tangent plane [m]: how far a contact point runs per radian of rolling."""

    @cached_property
    def rows(self) -> list[int]:
        """Rows of the ``6 n_c`` components that the contact models transmit."""
        return selected_rows(self.models)

    @cached_property
    def normal_rows(self) -> list[int]:
        """Position of each contact's normal force in ``mu``."""
        return [place for place, row in enumerate(self.rows) if row % 6 == 0]

    @cached_property
    def row_index(self) -> Tensor:
        """:attr:`rows` as an index tensor on the device of the contacts."""
        return torch.tensor(self.rows, dtype=torch.int64, device=self.frame.device)

    @cached_property
    def normal_hat(self) -> Float[Tensor, "*batch n_c 3 3"]:
        """``[n_i]x``, the cross-product matrix of each outward normal."""
        return hat(self.contacts.normal)

    @cached_property
    def roll(self) -> Float[Tensor, "*batch n_c 3 3"]:
        """``M_i [n_i]x``: the contact point runs ``-M_i [n_i]x w_rel``."""
        return self.mobility @ self.normal_hat

    @cached_property
    def relative_spin(self) -> Float[Tensor, "*batch n_c 3 n_s"]:
        """Omega_i ds = w_finger - w_object: ``[J_w,i, 0, -I]``."""
        J_w = self.spin_jacobian
        tail = torch.zeros(*J_w.shape[:-1], 6, dtype=J_w.dtype, device=J_w.device)
        tail[..., 3:] = -torch.eye(3, dtype=J_w.dtype, device=J_w.device)
        return torch.cat([J_w, tail], dim=-1)


def contact_frames(
    normal: Float[Tensor, "*batch n_c 3"], plane: Float[Tensor, " 3"] | None = None
) -> Float[Tensor, "*batch n_c 3 3"]:
    """``C_i = [n_in, t1, t2]``, right-handed, ``n_in = -n``.

    Without ``plane`` the tangents come from the branch-free construction of Duff et al.,
    Building an Orthonormal Basis, Revisited (JCGT 2017). With the normal of a plane of motion
    ``t1`` lies in the plane: ``t1 = plane x n_in``.
    """
    n_in = -normal
    if plane is not None:
        t1 = torch.linalg.cross(plane.expand_as(n_in), n_in)
        t1 = t1 / torch.linalg.vector_norm(t1, dim=-1, keepdim=True).clamp_min(1e-12)
        return torch.stack([n_in, t1, torch.linalg.cross(n_in, t1)], dim=-1)
    # a reflection takes -+e_z to n_in, and e_x and e_y to the tangents
    eye = torch.eye(3, dtype=n_in.dtype, device=n_in.device)
    sign = torch.copysign(torch.ones_like(n_in[..., 2:]), n_in[..., 2:])
    across = n_in[..., :2] / (1 + sign * n_in[..., 2:])
    tangent = eye[:, :2] - (n_in + sign * eye[2])[..., None] * across[..., None, :]
    t1, t2 = tangent.split(1, dim=-1)
    return torch.cat([n_in[..., None], t1, sign[..., None] * t2], dim=-1)


def rolling_mobility(contacts: ContactSet) -> Float[Tensor, "*batch n_c 3 3"]:
    """``(K_f + K_o)^+`` in the tangent plane [m]; 0 where pinned or along directions in which both are flat.

    In closed form, with the plane's projection P: ``(tr(K) P - K) / det(K)`` for rank two,
    ``K / tr(K)^2`` for rank one (a cylinder on a plane), 0 for rank nought.
    """
    n = contacts.normal
    P = torch.eye(3, dtype=n.dtype, device=n.device) - n[..., None] * n[..., None, :]
    K = P @ (contacts.finger_curvature + contacts.object_curvature) @ P
    trace, square = K.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None], (K * K).sum((-2, -1), keepdim=True)
    det = 0.5 * (trace * trace - square)
    small = 0.5 * (trace - (2 * square - trace * trace).clamp_min(0).sqrt())  # the smaller eigenvalue
    # 1 in place of a divisor that is not used: no NaN in a gradient
    full = small > FLAT
    inverse = (trace * P - K) / torch.where(full, det, 1.0)
    m = torch.where(full, inverse, K / torch.where(trace > FLAT, trace, torch.inf).square())
    if any(contacts.pinned):
        m = m * torch.tensor([not p for p in contacts.pinned], dtype=m.dtype, device=m.device)[:, None, None]
    return m


def contact_kinematics(
    contacts: ContactSet,
    position: Float[Tensor, "*batch 3"],
    axis: Float[Tensor, "*batch n_q 3"],
    origin: Float[Tensor, "*batch n_q 3"],
    upstream: Bool[Tensor, "n_c n_q"],
    *,
    plane: Float[Tensor, " 3"] | None = None,
    rolling: bool = True,
) -> ContactKinematics:
    """Velocity of the contact points: ``J_v[:, j] = z_j x (x_i - o_j)``, ``J_w[:, j] = z_j``.

    Args:
        contacts: who touches where.
        position: object point ``o`` [m].
        axis: joint axes ``z_j``.
        origin: a point ``o_j`` on each axis [m].
        upstream: joint j moves the link of contact i.
        plane: normal of the plane of motion of a planar hand.
        rolling: False treats every contact as pinned (for comparison).
    """
    frame = contact_frames(contacts.normal, plane)
    mask = upstream.to(axis.dtype)[..., None]
    spin = axis[..., None, :, :] * mask
    arm = contacts.point[..., :, None, :] - origin[..., None, :, :]
    velocity = torch.linalg.cross(spin, arm)
    return ContactKinematics(
        contacts=contacts,
        models=contact_models(contacts, planar=plane is not None),
        frame=frame,
        lever=contacts.point - position[..., None, :],
        axis=axis,
        point_jacobian=velocity.mT,
        spin_jacobian=spin.mT,
        mobility=rolling_mobility(contacts) if rolling else torch.zeros_like(frame),
    )


def full_hand_jacobian(kin: ContactKinematics) -> Float[Tensor, "*batch rows n_q"]:
    """``J~_h``: rows ``blkdiag(C_i, C_i)^T [J_v,i; J_w,i]``, stacked over the contacts."""
    C_t = kin.frame.mT
    rows = torch.cat([C_t @ kin.point_jacobian, C_t @ kin.spin_jacobian], dim=-2)
    return rows.flatten(-3, -2)


def full_grasp_matrix(kin: ContactKinematics) -> Float[Tensor, "*batch 6 rows"]:
    """``G~``: blocks ``[C_i, 0; [r_i]x C_i, C_i]``; maps contact forces to the wrench about ``o``."""
    C = kin.frame
    moment = hat(kin.lever) @ C
    top = torch.cat([C, torch.zeros_like(C)], dim=-1)
    bottom = torch.cat([moment, C], dim=-1)
    return torch.cat([top, bottom], dim=-2).movedim(-3, -2).flatten(-2)


def hand_jacobian(kin: ContactKinematics) -> Float[Tensor, "*batch n_h n_q"]:
    """``J_h = H J~_h``: joint velocities to those contact velocities that the models transmit [m/rad]."""
    return full_hand_jacobian(kin).index_select(-2, kin.row_index)


def grasp_matrix(kin: ContactKinematics) -> Float[Tensor, "*batch 6 n_h"]:
    """``G = G~ H^T``: contact forces ``mu`` [N, N m] to the wrench on the object about ``o`` [N, N m]."""
    return full_grasp_matrix(kin).index_select(-1, kin.row_index)


def constraint_matrix(kin: ContactKinematics) -> Float[Tensor, "*batch n_h n_s"]:
    """``A = [J_h, -G^T]``: contacts stick, ``A ds = 0``."""
    return torch.cat([hand_jacobian(kin), -grasp_matrix(kin).mT], dim=-1)
