"""How contact points move with the joints and the object: everything about a contact that the model needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

from .._arrays import eye, like, namespace, zeros
from ..kinematics.poses import cross, hat
from ..typing import AnyArray, Bool, Float
from .contact_set import ContactSet


class ContactModel(Enum):
    """Rows of a contact's six components ``[f_n, f_t1, f_t2, m_n, m_t1, m_t2]`` that it transmits."""

    FRICTIONLESS = (0,)
    POINT_WITH_FRICTION = (0, 1, 2)
    """Point contact with friction, also called hard finger."""
    PLANAR_POINT_WITH_FRICTION = (0, 1)
    """The same in a planar hand: ``t1`` lies in the plane of motion."""
    SOFT_FINGER = (0, 1, 2, 3)
    """And a moment about the normal."""

    @property
    def rows(self) -> tuple[int, ...]:
        return self.value


def contact_models(contacts: ContactSet, *, planar: bool = False) -> tuple[ContactModel, ...]:
    """The model that each contact's coefficients ask for.

    No friction: frictionless. Else, in a planar hand: planar point contact with friction; in space a soft
    finger if the torsional coefficient ``gamma > 0``, else a point contact with friction.
    """
    models = []
    for mu_s, gamma in zip(contacts.friction.tolist(), contacts.torsional_friction.tolist(), strict=True):
        if mu_s <= 0:
            models.append(ContactModel.FRICTIONLESS)
        elif planar:
            models.append(ContactModel.PLANAR_POINT_WITH_FRICTION)
        else:
            models.append(ContactModel.SOFT_FINGER if gamma > 0 else ContactModel.POINT_WITH_FRICTION)
    return tuple(models)


def selected_rows(models: Sequence[ContactModel]) -> list[int]:
    """Indices into the ``6 n_c`` stacked components that ``H`` keeps (``n_h`` of them).

    ``J_h = H J~_h`` and ``G = G~ H^T`` (Prattichizzo and Trinkle, Grasping, 2008).
    """
    return [6 * i + row for i, model in enumerate(models) for row in model.rows]


FLAT = 1.0
"""Curvature [1/m] below which a direction counts as flat: a radius above 1 m."""


@dataclass(frozen=True)
class ContactKinematics:
    """Geometry of ``n_c`` contacts at one state (or a batch), hand frame."""

    contacts: ContactSet
    models: tuple[ContactModel, ...]
    frame: Float[AnyArray, "*batch n_c 3 3"]
    """C_i: columns ``n_in = -n``, ``t1``, ``t2``."""
    lever: Float[AnyArray, "*batch n_c 3"]
    """r_i = x_i - o [m]."""
    axis: Float[AnyArray, "*batch n_q 3"]
    """z_j, unit vectors along the joint axes, hand frame."""
    point_jacobian: Float[AnyArray, "*batch n_c 3 n_q"]
    """Velocity of the finger's material point at x_i [m/rad]."""
    spin_jacobian: Float[AnyArray, "*batch n_c 3 n_q"]
    """Angular velocity of the finger link."""
    mobility: Float[AnyArray, "*batch n_c 3 3"]
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
    def row_index(self) -> AnyArray:
        """:attr:`rows` as an index on the device of the contacts."""
        return namespace(self.frame).asarray(self.rows, device=self.frame.device)

    @cached_property
    def normal_hat(self) -> Float[AnyArray, "*batch n_c 3 3"]:
        """``[n_i]x``, the cross-product matrix of each outward normal."""
        return hat(self.contacts.normal)

    @cached_property
    def roll(self) -> Float[AnyArray, "*batch n_c 3 3"]:
        """``M_i [n_i]x``: the contact point runs ``-M_i [n_i]x w_rel``."""
        return self.mobility @ self.normal_hat

    @cached_property
    def relative_spin(self) -> Float[AnyArray, "*batch n_c 3 n_s"]:
        """Omega_i ds = w_finger - w_object: ``[J_w,i, 0, -I]``."""
        J_w = self.spin_jacobian
        tail = zeros(J_w, *J_w.shape[:-1], 6)
        tail[..., 3:] = -eye(J_w, 3)
        return namespace(J_w).concat([J_w, tail], -1)


def contact_frames(
    normal: Float[AnyArray, "*batch n_c 3"], plane: Float[AnyArray, " 3"] | None = None
) -> Float[AnyArray, "*batch n_c 3 3"]:
    """``C_i = [n_in, t1, t2]``, right-handed, ``n_in = -n``.

    Without ``plane`` the tangents come from the branch-free construction of Duff et al.,
    Building an Orthonormal Basis, Revisited (JCGT 2017). With the normal of a plane of motion
    ``t1`` lies in the plane: ``t1 = plane x n_in``.
    """
    n_in, xp = -normal, namespace(normal)
    if plane is not None:
        t1 = cross(like(plane, n_in) + 0 * n_in, n_in)
        t1 = t1 / xp.sqrt((t1 * t1).sum(-1))[..., None].clip(1e-12)
        return xp.stack([n_in, t1, cross(n_in, t1)], -1)
    # a reflection takes -+e_z to n_in, and e_x and e_y to the tangents
    axes = eye(n_in, 3)
    sign = xp.copysign(xp.ones_like(n_in[..., 2:]), n_in[..., 2:])
    across = n_in[..., :2] / (1 + sign * n_in[..., 2:])
    tangent = axes[:, :2] - (n_in + sign * axes[2])[..., None] * across[..., None, :]
    return xp.concat([n_in[..., None], tangent[..., :1], sign[..., None] * tangent[..., 1:]], -1)


def rolling_mobility(contacts: ContactSet) -> Float[AnyArray, "*batch n_c 3 3"]:
    """``(K_f + K_o)^+`` in the tangent plane [m]; 0 where pinned or along directions in which both are flat.

    In closed form, with the plane's projection P: ``(tr(K) P - K) / det(K)`` for rank two,
    ``K / tr(K)^2`` for rank one (a cylinder on a plane), 0 for rank nought.
    """
    n, xp = contacts.normal, namespace(contacts.normal)
    P = eye(n, 3) - n[..., None] * n[..., None, :]
    K = P @ (contacts.finger_curvature + contacts.object_curvature) @ P
    trace = (K[..., 0, 0] + K[..., 1, 1] + K[..., 2, 2])[..., None, None]
    square = (K * K).sum((-2, -1))[..., None, None]
    det = 0.5 * (trace * trace - square)
    small = 0.5 * (trace - xp.sqrt((2 * square - trace * trace).clip(0)))  # the smaller eigenvalue
    # 1 in place of a divisor that is not used: no NaN in a gradient
    full = small > FLAT
    inverse = (trace * P - K) / xp.where(full, det, 1.0)
    m = xp.where(full, inverse, K / xp.where(trace > FLAT, trace, xp.inf) ** 2)
    if any(contacts.pinned):
        rolls = xp.asarray([not p for p in contacts.pinned], dtype=n.dtype, device=n.device)
        m = m * rolls[:, None, None]
    return m


def contact_kinematics(
    contacts: ContactSet,
    position: Float[AnyArray, "*batch 3"],
    axis: Float[AnyArray, "*batch n_q 3"],
    origin: Float[AnyArray, "*batch n_q 3"],
    upstream: Bool[AnyArray, "n_c n_q"],
    *,
    plane: Float[AnyArray, " 3"] | None = None,
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
    spin = axis[..., None, :, :] * upstream[..., None]
    arm = contacts.point[..., :, None, :] - origin[..., None, :, :]
    velocity = cross(spin, arm)
    return ContactKinematics(
        contacts=contacts,
        models=contact_models(contacts, planar=plane is not None),
        frame=frame,
        lever=contacts.point - position[..., None, :],
        axis=axis,
        point_jacobian=velocity.mT,
        spin_jacobian=spin.mT,
        mobility=rolling_mobility(contacts) if rolling else 0 * frame,
    )


def full_hand_jacobian(kin: ContactKinematics) -> Float[AnyArray, "*batch rows n_q"]:
    """``J~_h``: rows ``blkdiag(C_i, C_i)^T [J_v,i; J_w,i]``, stacked over the contacts."""
    C_t, xp = kin.frame.mT, namespace(kin.frame)
    rows = xp.concat([C_t @ kin.point_jacobian, C_t @ kin.spin_jacobian], -2)
    return rows.reshape(*rows.shape[:-3], -1, rows.shape[-1])


def full_grasp_matrix(kin: ContactKinematics) -> Float[AnyArray, "*batch 6 rows"]:
    """``G~``: blocks ``[C_i, 0; [r_i]x C_i, C_i]``; maps contact forces to the wrench about ``o``."""
    C, xp = kin.frame, namespace(kin.frame)
    moment = hat(kin.lever) @ C
    top, bottom = xp.concat([C, 0 * C], -1), xp.concat([moment, C], -1)
    blocks = xp.swapaxes(xp.concat([top, bottom], -2), -3, -2)
    return blocks.reshape(*blocks.shape[:-2], -1)


def hand_jacobian(kin: ContactKinematics) -> Float[AnyArray, "*batch n_h n_q"]:
    """``J_h = H J~_h``: joint velocities to those contact velocities that the models transmit [m/rad]."""
    return full_hand_jacobian(kin)[..., kin.row_index, :]


def grasp_matrix(kin: ContactKinematics) -> Float[AnyArray, "*batch 6 n_h"]:
    """``G = G~ H^T``: contact forces ``mu`` [N, N m] to the wrench on the object about ``o`` [N, N m]."""
    return full_grasp_matrix(kin)[..., kin.row_index]


def constraint_matrix(kin: ContactKinematics) -> Float[AnyArray, "*batch n_h n_s"]:
    """``A = [J_h, -G^T]``: contacts stick, ``A ds = 0``."""
    return namespace(kin.frame).concat([hand_jacobian(kin), -grasp_matrix(kin).mT], -1)
