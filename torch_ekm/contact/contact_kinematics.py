"""How contact points move with the joints and the object: everything about a contact that the model needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from ..kinematics.se3 import hat
from ..typing import Bool, Float, Tensor
from .contact_model import ContactModel, contact_models, normal_rows, selected_rows
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
    """z_j, joint axes."""
    point_jacobian: Float[Tensor, "*batch n_c 3 n_q"]
    """Velocity of the finger's material point at x_i [m/rad]."""
    spin_jacobian: Float[Tensor, "*batch n_c 3 n_q"]
    """Angular velocity of the finger link."""
    mobility: Float[Tensor, "*batch n_c 3 3"]
    """(K_f + K_o)^+ in the tangent plane [m]: how far a contact point runs per radian of rolling."""

    @property
    def rows(self) -> list[int]:
        """Rows of the ``6 n_c`` components that the contact models transmit."""
        return selected_rows(self.models)

    @property
    def normal_rows(self) -> list[int]:
        """Position of each contact's normal force in ``mu``."""
        return normal_rows(self.models)

    @property
    def relative_spin(self) -> Float[Tensor, "*batch n_c 3 n_s"]:
        """Omega_i ds = w_finger - w_object: ``[J_w,i, 0, -I]``."""
        J_w = self.spin_jacobian
        tail = torch.zeros(*J_w.shape[:-1], 6, dtype=J_w.dtype, device=J_w.device)
        tail[..., 3:] = -torch.eye(3, dtype=J_w.dtype, device=J_w.device)
        return torch.cat([J_w, tail], dim=-1)


def contact_frames(
    normal: Float[Tensor, "*batch n_c 3"], plane: Float[Tensor, 3] | None = None
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
    x, y, z = n_in.unbind(-1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    t1 = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=-1)
    t2 = torch.stack([b, sign + y * y * a, -y], dim=-1)
    return torch.stack([n_in, t1, t2], dim=-1)


def rolling_mobility(
    contacts: ContactSet, frame: Float[Tensor, "*batch n_c 3 3"]
) -> Float[Tensor, "*batch n_c 3 3"]:
    """``(K_f + K_o)^+`` in the tangent plane [m]; 0 where pinned or along directions in which both are flat.

    The 2x2 pseudo-inverse is taken in closed form: the inverse for rank two,
    ``K / tr(K)^2`` for rank one (a cylinder on a plane), 0 for rank nought.
    """
    tangent = frame[..., 1:]
    k = tangent.mT @ (contacts.finger_curvature + contacts.object_curvature) @ tangent
    a, b, c = k[..., 0, 0], 0.5 * (k[..., 0, 1] + k[..., 1, 0]), k[..., 1, 1]
    trace, det = a + c, a * c - b * b
    small = 0.5 * (trace - torch.sqrt((a - c) ** 2 + 4 * b * b))  # the smaller eigenvalue
    full = small > FLAT
    inverse = torch.stack([c, -b, -b, a], dim=-1) / torch.where(full, det, torch.ones_like(det))[..., None]
    single = torch.stack([a, b, b, c], dim=-1) / torch.where(trace > FLAT, trace, torch.inf)[..., None] ** 2
    m = torch.where(full[..., None], inverse, single).unflatten(-1, (2, 2))
    if any(contacts.pinned):
        m = m * torch.tensor([not p for p in contacts.pinned], dtype=m.dtype, device=m.device)[:, None, None]
    return tangent @ m @ tangent.mT


def contact_kinematics(
    contacts: ContactSet,
    position: Float[Tensor, "*batch 3"],
    axis: Float[Tensor, "*batch n_q 3"],
    origin: Float[Tensor, "*batch n_q 3"],
    upstream: Bool[Tensor, "n_c n_q"],
    *,
    models: Sequence[ContactModel] | None = None,
    plane: Float[Tensor, 3] | None = None,
    rolling: bool = True,
) -> ContactKinematics:
    """Velocity of the contact points: ``J_v[:, j] = z_j x (x_i - o_j)``, ``J_w[:, j] = z_j``.

    Args:
        contacts: who touches where.
        position: object point ``o`` [m].
        axis: joint axes ``z_j``.
        origin: a point ``o_j`` on each axis [m].
        upstream: joint j moves the link of contact i.
        models: contact models; by default what the friction coefficients say.
        plane: normal of the plane of motion of a planar hand.
        rolling: False treats every contact as pinned (for comparison).
    """
    frame = contact_frames(contacts.normal, plane)
    mask = upstream.to(axis.dtype)[..., None]
    spin = axis[..., None, :, :] * mask
    arm = contacts.point[..., :, None, :] - origin[..., None, :, :]
    velocity = torch.linalg.cross(spin, arm)
    if models is None:
        models = contact_models(contacts, planar=plane is not None)
    return ContactKinematics(
        contacts=contacts,
        models=tuple(models),
        frame=frame,
        lever=contacts.point - position[..., None, :],
        axis=axis,
        point_jacobian=velocity.mT,
        spin_jacobian=spin.mT,
        mobility=rolling_mobility(contacts, frame) if rolling else torch.zeros_like(frame),
    )


def full_hand_jacobian(kin: ContactKinematics) -> Float[Tensor, "*batch 6*n_c n_q"]:
    """``J~_h``: rows ``blkdiag(C_i, C_i)^T [J_v,i; J_w,i]``, stacked over the contacts."""
    C_t = kin.frame.mT
    rows = torch.cat([C_t @ kin.point_jacobian, C_t @ kin.spin_jacobian], dim=-2)
    return rows.flatten(-3, -2)


def full_grasp_matrix(kin: ContactKinematics) -> Float[Tensor, "*batch 6 6*n_c"]:
    """``G~``: blocks ``[C_i, 0; [r_i]x C_i, C_i]``; maps contact forces to the wrench about ``o``."""
    C = kin.frame
    moment = hat(kin.lever) @ C
    top = torch.cat([C, torch.zeros_like(C)], dim=-1)
    bottom = torch.cat([moment, C], dim=-1)
    return torch.cat([top, bottom], dim=-2).movedim(-3, -2).flatten(-2)


def hand_jacobian(kin: ContactKinematics) -> Float[Tensor, "*batch n_h n_q"]:
    """``J_h = H J~_h``."""
    return full_hand_jacobian(kin)[..., kin.rows, :]


def grasp_matrix(kin: ContactKinematics) -> Float[Tensor, "*batch 6 n_h"]:
    """``G = G~ H^T``."""
    return full_grasp_matrix(kin)[..., kin.rows]


def constraint_matrix(kin: ContactKinematics) -> Float[Tensor, "*batch n_h n_s"]:
    """``A = [J_h, -G^T]``: contacts stick, ``A ds = 0``."""
    return torch.cat([hand_jacobian(kin), -grasp_matrix(kin).mT], dim=-1)
