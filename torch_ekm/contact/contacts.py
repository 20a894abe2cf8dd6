"""The contacts of a grasp, as data, and how their points move with the joints and the object."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import torch

from .._arrays import as_tensors, eye, like, namespace, zeros
from ..exceptions import NonFiniteError, ParameterError, ShapeError
from ..kinematics.se3 import cross, hat
from ..typing import AnyArray, Bool, Float, Tensor

CHARACTERISTIC_LENGTH = 0.03
"""L [m], size of a held object: what makes lengths comparable with angles, and moments with forces."""
LINK_MARGIN = 0.001
"""Gap up to which a link that is no pad is reported as touching [m]."""
_UNIT = 1e-4
"""How far the length of a normal may be from 1."""
_TAILS: dict[str, tuple[int, ...]] = {
    "point": (3,),
    "normal": (3,),
    "gap": (),
    "finger_curvature": (3, 3),
    "object_curvature": (3, 3),
    "friction": (),
    "torsional_friction": (),
}
#: Fields that do not vary over a batch.
SHARED = ("friction", "torsional_friction")
#: The others, with the number of their dimensions for one contact set.
VARYING = {name: 1 + len(tail) for name, tail in _TAILS.items() if name not in SHARED}


@dataclass(frozen=True)
class NearMiss:
    """What is near the object and counts as no contact: a pad beyond the margin, or a link that is no pad."""

    link: str
    pad: str | None
    """None: a link, with which the model does not reckon."""
    gap: float
    """Signed distance to the object [m]."""


@dataclass(frozen=True)
class ContactSet:
    """``n_c`` contacts between finger links and the object, in the hand frame.

    The same links touch over a whole batch; only numbers vary along ``*batch``.
    Curvature tensors live in the tangent plane (``K n = 0``) and are positive for convex
    bodies; 0 is flat, and an infinitely sharp (pinned) contact is said by ``pinned``.
    Arrays and nested lists are converted, and all fields get the widest of their precisions.

    Raises:
        ShapeError: the fields do not belong together.
        ParameterError: a field that is not made of numbers.
    """

    finger: tuple[str, ...]
    """Name of the contact pad of each contact."""
    link: tuple[str, ...]
    """Link that carries it."""
    point: Float[Tensor, "*batch n_c 3"]
    """x_i, contact point [m]."""
    normal: Float[Tensor, "*batch n_c 3"]
    """n_i, outward normal of the **object**; the finger presses along ``-n_i``."""
    gap: Float[Tensor, "*batch n_c"]
    """Signed distance between the surfaces [m]; negative: they overlap."""
    finger_curvature: Float[Tensor, "*batch n_c 3 3"]
    """K_f, curvature of the finger pad at the contact [1/m]."""
    object_curvature: Float[Tensor, "*batch n_c 3 3"]
    """K_o, curvature of the object's surface there [1/m]."""
    friction: Float[Tensor, " n_c"]
    """Coulomb coefficient mu_s of each contact."""
    torsional_friction: Float[Tensor, " n_c"]
    """Soft-finger coefficient gamma [m]; 0: a point contact with friction."""
    pinned: tuple[bool, ...] = ()
    """Contact is a material point of both bodies (sharp tip or edge): no rolling term."""
    near_misses: tuple[NearMiss, ...] = ()
    """What the detector left out."""

    def __post_init__(self) -> None:
        n_c = len(self.finger)
        given = {name: getattr(self, name) for name in _TAILS}
        for name, value in zip(given, as_tensors(**given), strict=True):
            object.__setattr__(self, name, value)  # the dataclass is frozen
        if not self.pinned:
            object.__setattr__(self, "pinned", (False,) * n_c)
        for name, tail in _TAILS.items():
            shape, expected = tuple(getattr(self, name).shape), (n_c, *tail)
            if shape[-len(expected) :] != expected:
                raise ShapeError(f"ContactSet.{name}", f"(*batch, {', '.join(map(str, expected))})", shape)
        for name in ("link", "pinned"):
            if len(getattr(self, name)) != n_c:
                raise ShapeError(f"ContactSet.{name}", f"{n_c} entries", (len(getattr(self, name)),))

    def check(self) -> None:
        """The numbers must make sense; apart from the constructor, which also runs where tensors have none.

        Raises:
            NonFiniteError: a NaN or an infinity; ``pinned`` says that a contact is infinitely sharp.
            ParameterError: a normal that is no unit vector, or a negative coefficient of friction.
        """
        if not bool(torch.isfinite(torch.cat([getattr(self, name).flatten() for name in _TAILS])).all()):
            name = next(name for name in _TAILS if not bool(torch.isfinite(getattr(self, name)).all()))
            raise NonFiniteError(f"contacts.{name}")
        size = torch.linalg.vector_norm(self.normal, dim=-1).flatten().tolist()
        if size and not (min(size) > 1 - _UNIT and max(size) < 1 + _UNIT):
            worst = max(range(len(size)), key=lambda k: abs(size[k] - 1))
            where = f"contacts.normal of '{self.finger[worst % self.n_c]}'"
            normal = self.normal.reshape(-1, 3)[worst].tolist()
            raise ParameterError(where, normal, f"of unit length, not {size[worst]:.4g}")
        for name in ("friction", "torsional_friction"):
            for finger, value in zip(self.finger, getattr(self, name).tolist(), strict=True):
                if value < 0:
                    raise ParameterError(f"contacts.{name} of '{finger}'", value, "not negative")

    @property
    def n_c(self) -> int:
        """Number of contacts, the same for all states of a batch."""
        return len(self.finger)

    @property
    def batch_shape(self) -> torch.Size:
        return self.gap.shape[:-1]

    def select(self, index: Sequence[int]) -> ContactSet:
        """Some of the contacts, in the order of ``index``."""
        at = list(index)
        parts = {
            name: getattr(self, name).movedim(-1 - len(tail), 0)[at].movedim(0, -1 - len(tail))
            for name, tail in _TAILS.items()
        }
        names = {name: tuple(getattr(self, name)[i] for i in at) for name in ("finger", "link", "pinned")}
        return self.replace(**parts, **names)

    def replace(self, **changes: Any) -> ContactSet:
        """A copy with the given fields changed, checked like a new set."""
        return dataclasses.replace(self, **changes)


@runtime_checkable
class Detector(Protocol):
    """Finds the contacts of one state, hand frame: :class:`ContactDetector` or one's own."""

    def __call__(self, q: Tensor, position: Tensor, rotation: Tensor, /) -> ContactSet: ...


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


_TOLERANCE = 1e-8  # of the rank decisions


@dataclass(frozen=True)
class GraspAnalysis:
    """Ranks of one grasp; every rank is decided on matrices scaled by the object's size.

    Names after Prattichizzo and Trinkle, Grasping, Springer Handbook of Robotics, 2008.
    """

    mobility: int
    """dim null A: degrees of freedom of hand and object that the contacts leave."""
    internal_forces: int
    """dim null G: contact force combinations that cancel on the object."""
    undetermined_forces: int
    """n_h + n_a - rank [A; B]: combinations of contact and actuator forces that equilibrium leaves open."""
    indeterminate: bool
    """null G^T: some object motion does not show at the contacts."""


def analyse(kin: ContactKinematics, actuation: Float[Tensor, "n_a n_q"]) -> GraspAnalysis:
    """Ranks and classes of one grasp (no batch); of a planar hand: of forces and motions in the plane.

    Args:
        kin: its contacts.
        actuation: J_a.
    """
    A, n_q, L = constraint_matrix(kin), actuation.shape[-1], CHARACTERISTIC_LENGTH
    scale = A.new_ones(n_q + 6)
    scale[n_q : n_q + 3] = L
    row = torch.tensor([1 / L if r % 6 < 3 else 1.0 for r in kin.rows], dtype=A.dtype, device=A.device)
    A_s = row[:, None] * A * scale
    # the plane's normal is each contact's second tangent
    if {*kin.models} == {ContactModel.PLANAR_POINT_WITH_FRICTION}:
        n, t, normal = kin.frame[0].unbind(-1)
        plane = A.new_zeros(6, 3)
        plane[:3, 0], plane[:3, 1], plane[3:, 2] = n, t, normal
        A_s = torch.cat([A_s[:, :n_q], A_s[:, n_q:] @ plane], dim=-1)
    arm = torch.linalg.vector_norm(actuation, dim=-1, keepdim=True).clamp_min(1e-12)
    B_s = torch.cat([actuation / arm, actuation.new_zeros(len(actuation), A_s.shape[1] - n_q)], dim=-1)

    def rank(matrix: Tensor) -> int:
        return int(torch.linalg.matrix_rank(matrix, rtol=_TOLERANCE)) if matrix.numel() else 0

    G_s = A_s[:, n_q:].mT
    n_h, n_p = G_s.shape[1], G_s.shape[0]
    rank_G = rank(G_s)
    return GraspAnalysis(
        mobility=A_s.shape[1] - rank(A_s),
        internal_forces=n_h - rank_G,
        undetermined_forces=n_h + len(actuation) - rank(torch.cat([A_s, B_s])),
        indeterminate=rank_G < n_p,
    )
