"""A grasp at one state, as the equations of a step see it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..._arrays import in_numpy
from ...contact.contacts import (
    CHARACTERISTIC_LENGTH,
    ContactKinematics,
    ContactModel,
    ContactSet,
    Detector,
    full_grasp_matrix,
    full_hand_jacobian,
)
from ...description.hand import HandDescription
from ...kinematics.poses import GraspState, Kinematics, LinkPoses, hat
from ...typing import AnyArray, Array, Tensor
from ..linearization import FollowedFigures, normal_motion
from ..reduction import Reduction
from ..stiffness import arms_at, bends
from ..validity import ModelOptions

L = CHARACTERISTIC_LENGTH
_LENGTHS = np.array([L, L, L, 1.0, 1.0, 1.0])[:, None]
_NONE = np.zeros(3)


@runtime_checkable
class GraspModel(Protocol):
    """What is asked of a model of hand and object: :class:`~torch_ekm.model.KinematicModel`."""

    hand: HandDescription
    options: ModelOptions
    kinematics: Kinematics
    reduction: Reduction
    spring_rest: Tensor
    figures: FollowedFigures | None

    @property
    def touch_detector(self) -> Detector: ...

    def contact_kinematics(
        self, state: GraspState, contacts: ContactSet, *, poses: LinkPoses | None = None
    ) -> ContactKinematics: ...

    def potential(self, state: GraspState) -> tuple[Any, Any]: ...

    def load_stiffness(self, kin: ContactKinematics, force: AnyArray, spin_moment: AnyArray) -> Any: ...


@dataclass(frozen=True)
class ContactLoads:
    """Forces that finger and object exchange, by contact; what is not named bears nothing."""

    force: dict[str, Array]
    """f_i of the finger on the object, hand axes [N]."""
    spin: dict[str, float]
    """About the inward normal [N m]."""
    pull: Array
    """Force of each actuator along +a, ``(n_a,)`` [N m]; of a tendon below 0 where it is slack, by what it
    would have to be shortened times its stiffness."""
    stop: Array
    """Torque of joint stops on the joints, ``(n_q,)`` [N m]."""
    loop: Array
    """Forces of the loops, ``(n_l,)``."""


class PlacedGrasp:
    """Matrices of one state and its contacts in permitted, scaled coordinates z: ``ds = S z``.

    Args:
        model: its detector finds pads and links.
        state: where.
        contacts: there.
        poses: of the links there.
        springs: change of their stiffness against the description, ``(n_q,)`` [N m/rad].
    """

    def __init__(
        self, model: GraspModel, state: GraspState, contacts: ContactSet, poses: LinkPoses, springs: Array
    ) -> None:
        self.state, self.contacts = state, contacts
        at, near = in_numpy(state), in_numpy(contacts)
        self.kin: ContactKinematics = model.contact_kinematics(at, near, poses=poses)
        self._model = model
        kin, S = self.kin, model.reduction.scaled_basis.numpy()
        A = np.concatenate([full_hand_jacobian(kin), -full_grasp_matrix(kin).mT], axis=-1) @ S
        A = A.reshape(contacts.n_c, 6, S.shape[1]) / _LENGTHS
        self.normal_rate = A[:, 0]  # how fast the finger nears the object
        mu_s, gamma, self.frame = (np.asarray(x) for x in (near.friction, near.torsional_friction, kin.frame))
        # where a contact slides, its point moves over the object by M K_f v and over the finger by -M K_o v
        slide = L * self.frame[:, :, 1:] @ A[:, 1:3]  # v of hand axes, (n_c, 3, n_z)
        mobility, K_o = kin.mobility, near.object_curvature
        self._object_run = mobility @ near.finger_curvature @ slide
        self._finger_run = -mobility @ K_o @ slide
        turn = normal_motion(kin, S) + K_o @ self._object_run  # (n_c, 3, n_z)
        d = max([len(one.rows) - 1 for one in kin.models], default=0)
        n_c, n_z = contacts.n_c, S.shape[1]
        self.mu_s, self.T, self.turn = mu_s, np.zeros((n_c, d, n_z)), np.zeros((n_c, d, n_z))
        self.spin_scale = np.zeros(n_c)  # [N m] of spin for a force of 1 N times L
        for i, one in enumerate(kin.models):
            n = len(one.rows) - 1
            self.T[i, :n] = A[i, 1 : n + 1]
            if one is ContactModel.SOFT_FINGER:
                self.spin_scale[i] = gamma[i] / (mu_s[i] * L)
                self.T[i, 2] *= self.spin_scale[i]
            self.turn[i, : min(n, 2)] = self.frame[i, :, 1 : 1 + min(n, 2)].T @ turn[i]
        V_s, self._V_ss = model.potential(at)
        n_q = len(springs)
        V_s[:n_q] += springs * (at.q - model.spring_rest.numpy())
        self._V_ss[:n_q, :n_q] += np.diag(springs)
        self.torque = V_s @ S
        self._arms, self._S_q, loops = arms_at(model.hand, at.q), S[:n_q], model.hand.loops
        self.closed = np.zeros((0, S.shape[1])) if loops is None else self._arms.closed @ self._S_q
        """dc/dz of the loops ``(n_l, n_z)``."""
        self.gap = np.zeros(0) if loops is None else loops.gap(state.q.numpy())
        """c(q)."""

    def along(self, J_a: Array) -> Array:
        """dl/dz of the actuators ``(n_a, n_z)``; J_a: of the description, or as it is known."""
        return np.asarray(self._arms.of(J_a) @ self._S_q)

    def stiffness(self, loads: ContactLoads) -> Array:
        """``Z^T D Z`` at these forces, which turn with the normals."""
        contacts, model = self.contacts, self._model
        force = np.array([loads.force.get(name, _NONE) for name in contacts.finger])
        spin = np.array([loads.spin.get(name, 0.0) for name in contacts.finger])
        S = model.reduction.scaled_basis.numpy()
        D = model.load_stiffness(self.kin, force, spin) + self._V_ss
        if self._arms.varies:
            n_q, J_a = model.hand.n_q, model.reduction.actuation.detach().numpy()
            D[:n_q, :n_q] += bends(model.hand, self.state.q.numpy(), J_a, -loads.pull, loads.loop)
        D = S.T @ D @ S
        f_hat = hat(force)
        spin_f = (self.kin.spin_jacobian @ S[: model.hand.n_q]).swapaxes(1, 2)
        D -= (spin_f @ f_hat @ self._finger_run).sum(0)
        D += S[-3:].T @ (f_hat @ self._object_run).sum(0)
        lam, t = self.components(loads)
        inward = (t[:, :, None] * self.turn).sum(1)
        D += self.normal_rate.T @ inward
        D -= self.T.reshape(-1, len(D)).T @ (lam[:, None, None] * self.turn).reshape(-1, len(D))
        return D

    def components(self, loads: ContactLoads) -> tuple[Array, Array]:
        """Normal forces ``(n_c,)`` and tangential ones ``(n_c, d)``, in contact frames [scaled]."""
        n_c, d = self.T.shape[:2]
        lam, t = np.zeros(n_c), np.zeros((n_c, d))
        for i, name in enumerate(self.contacts.finger):
            if name in loads.force:
                local = L * (self.frame[i].T @ loads.force[name])
                lam[i] = local[0]
                t[i, :2] = local[1 : 1 + min(d, 2)]
                if d == 3 and self.spin_scale[i] > 0:
                    t[i, 2] = loads.spin[name] / self.spin_scale[i]
        return lam, t

    def loads(self, lam: Array, t: Array, pull: Array, stop: Array, loop: Array) -> ContactLoads:
        """The inverse of :meth:`components`."""
        n_c, d = t.shape
        local = np.zeros((n_c, 3))
        local[:, 0] = lam
        local[:, 1 : 1 + min(d, 2)] = t[:, :2]
        names = self.contacts.finger
        force = (self.frame @ local[:, :, None])[..., 0] / L
        spin = t[:, 2] * self.spin_scale if d == 3 else np.zeros(n_c)
        return ContactLoads(
            dict(zip(names, force, strict=True)),
            dict(zip(names, spin.tolist(), strict=True)),
            pull,
            stop,
            loop,
        )

    def follow(self, increment: Array, loads: ContactLoads) -> Array:
        """The least motion of the joints after which contacts that bear are where they were, ``(n_s,)``."""
        S, n_y = self._model.reduction.scaled_basis.numpy(), self._model.reduction.joint_basis.shape[1]
        bears = self.components(loads)[0] > 0
        rows = np.concatenate([self.normal_rate[:, None], self.T], axis=1)[bears].reshape(-1, S.shape[1])
        away = rows @ np.linalg.lstsq(S, increment, rcond=None)[0]
        back = np.linalg.lstsq(rows[:, :n_y], away, rcond=1e-3)[0]
        return np.asarray(-S[:, :n_y] @ back, dtype=np.float64)

    def turned(self, lam: Array, t: Array, lam_0: Array, t_0: Array, z: Array) -> tuple[Array, Array]:
        """Components in the frames of this state, from those in frames that turned with the normals by z."""
        turn = self.turn @ z
        return lam + (t_0 * turn).sum(1), t - lam_0[:, None] * turn
