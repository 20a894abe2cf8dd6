"""What the kinematic model says about one state: forces, and how everything answers to the actuators."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch

from .._arrays import as_tensors, eye, in_numpy, in_torch, is_plain, like, norm, of_fields, zeros
from .._checks import check_finite, check_last
from ..contact.contacts import ContactKinematics, ContactSet
from ..kinematics.poses import GraspState
from ..typing import AnyArray, Bool, Float, Tensor
from .grasp_forces import ExpectedForces, GraspForces, drift, friction_use, start_covariance
from .reduction import Drives, Reduction, two_stage
from .stiffness import SAME, Arms
from .validity import Doubt, ModelOptions, ModelStatus


class FigureDerivative(NamedTuple):
    """Derivative of some rows of ``ds = J_m w`` with respect to the figures of the hand, ``(n_r, ...)``."""

    springs: Float[Tensor, "n_r n_q"]
    """By the stiffness of each joint's spring [per N m/rad]."""
    moment_arms: Float[Tensor, "n_r n_a n_q"]
    """By each entry of J_a."""
    stiffness: Float[Tensor, "n_r n_a"]
    """By K_a of each actuator [per N m/rad]; 0 of rigid ones and of slack tendons."""


@dataclass(frozen=True)
class MotionEquations:
    """``D ds + A^T dmu + J_a^T dlam = 0``, ``A ds = 0``, ``dlam = K_a (J_a ds - w)`` of one state.

    Contact forces, held joints and slack tendons are those that were found with the described figures.
    """

    reduction: Reduction
    stiffness: Float[Tensor, "n_s n_s"]
    """D, with the described springs."""
    constraints: Float[Tensor, "n_h n_s"]
    """A."""
    rows: tuple[int, ...]
    """Which of the 6 n_c contact components are the rows of A."""
    held: Bool[Tensor, " n_q"]
    slack: Bool[Tensor, " n_a"]
    moving: Bool[Tensor, " n_q"]
    """Joints of the fingers that touch."""
    arms: Arms = SAME
    """Moment arms and loops at the posture."""

    def solve(self, springs: Float[Tensor, " n_q"], drives: Drives) -> Motion:
        """J_m with other figures.

        Args:
            springs: their change against the described ones [N m/rad].
            drives: moment arms and stiffnesses of the actuators.

        Raises:
            SingularGraspError: a motion meets no stiffness.
            UnstableGraspError: the grasp buckles with these figures.
        """
        n_q = len(springs)
        D = self.stiffness.clone()
        D.diagonal()[:n_q] += springs
        return Motion(self, D, drives)


class Motion:
    """``ds = J_m w`` of one state and one set of figures, and its derivative by the figures."""

    def __init__(self, of: MotionEquations, D: Tensor, drives: Drives) -> None:
        reduction, self._n_h, self._arms = of.reduction, len(of.rows), of.arms
        plain = is_plain(D, of.constraints, *drives)
        given = (D, of.constraints, of.held, of.slack, *drives)
        stiffness, A, held, slack, J_a, K_a = (x.numpy() if plain else x for x in given)
        self._S, self._drives = like(reduction.scaled_basis, stiffness), Drives(J_a, K_a)
        self._system = system = reduction.reduced(
            stiffness, A, list(of.rows), held, slack, self._drives, of.arms
        )
        self._step = two_stage(system.D, system.E, system.R, system.F, actuators=reduction.actuators)
        self.jacobian: Float[Tensor, "n_s n_a"] = torch.as_tensor(self._S @ self._step.motion)
        """J_m."""

    def derivative(self, moved: Float[Tensor, " n_a"], rows: list[int]) -> FigureDerivative:
        """Of the rows of ``J_m w``, in closed form.

        One adjoint solve for each row serves all figures::

            [ D^T  E^T ] [ y  ]   [ e_c ]
            [ E    0   ] [ nu ] = [ 0   ]        d ds_c = -(y, nu)^T (d of the equations at ds, dlam)

        Args:
            moved: w [rad].
            rows: c, indices into ds.
        """
        system, S, n_h = self._system, self._S, self._n_h
        motion, reaction = self._step.adjoint(system.D, S[rows].mT)
        (J_a, K_a), arms_at = self._drives, self._arms
        J_a = arms_at.of(J_a)
        n_q = J_a.shape[1]
        w = like(moved, S)
        ds = (S @ (self._step.motion @ w))[:n_q]
        dlam = system.actuator_force(self._step, n_h) @ w
        y = (S[:n_q] @ motion).mT  # (n_r, n_q)
        along = y @ J_a.mT
        pull = 0 * along  # what a row answers to a change of each tendon's length
        stiffness = 0 * along
        soft, rigid = system.soft, system.rigid
        pull[:, soft] = along[:, soft] * K_a[soft]
        pull[:, rigid] = (reaction[n_h : n_h + len(rigid)] / system.arm).mT
        stiffness[:, soft] = -along[:, soft] * (dlam[soft] / K_a[soft])
        arms = -(dlam[:, None] * y[:, None, :] + pull[..., None] * ds)
        arms = arms_at.of(arms)
        return FigureDerivative(*map(torch.as_tensor, (-y * ds, arms, stiffness)))


@dataclass(frozen=True)
class Linearization:
    """``ds = J_m da`` and the force sensitivities at one state (or a batch).

    Rows of ``J_m``: joints [rad/rad], object point [m/rad], object rotation [rad/rad].
    """

    state: GraspState
    contacts: ContactSet
    forces: GraspForces
    manipulation_jacobian: Float[Tensor, "*batch n_s n_a"]
    """J_m."""
    contact_force_sensitivity: Float[Tensor, "*batch n_h n_a"]
    """dmu/da [N/rad]: change of the force vectors, read in the present contact frames."""
    normal_force_sensitivity: Float[Tensor, "*batch n_c n_a"]
    """d f_n/da [N/rad], the turning of the normals included: rows for regulating the grip."""
    force_vector_sensitivity: Float[Tensor, "*batch n_c 3 n_a"]
    """df/da [N/rad]: change of the force vectors in hand axes."""
    normal_motion: Float[Tensor, "*batch n_c 3 n_a"]
    """dn/da [1/rad]: turning of the object's outward normals at the contacts."""
    normal_rows: tuple[int, ...]
    """Position of each contact's normal force in ``mu``."""
    held_joints: Bool[Tensor, "*batch n_q"]
    """Joints that a stop holds."""
    stability: Float[Tensor, "*batch"]
    """Smallest eigenvalue of the stiffness with locked actuators, translations in units of L [N m/rad]."""
    options: ModelOptions
    """Those of the model."""
    equations: MotionEquations | None = None
    """What J_m follows from; None: of a batch."""
    described: Float[Tensor, "n_s n_a"] | None = None
    """J_m of the description, where J_m follows figures that were learned; None: it is that."""
    described_normal: Float[Tensor, "n_c n_a"] | None = None
    """d f_n/da of the model, where what was measured corrects it; None: it is that."""
    doubts: tuple[Doubt, ...] = ()
    """Why this linearization may be wrong, worst first."""

    @property
    def status(self) -> ModelStatus:
        """The kind of the worst doubt, or OK."""
        return self.doubts[0].kind if self.doubts else ModelStatus.OK

    @cached_property
    def _arrays(self) -> Linearization:
        """The same in numpy, without derivatives."""
        parts = {"forces": in_numpy(self.forces), "contacts": in_numpy(self.contacts)}
        return of_fields(Linearization, **vars(in_numpy(self)) | parts)

    @property
    def n_q(self) -> int:
        return self.state.q.shape[-1]

    @property
    def joint_jacobian(self) -> Float[Tensor, "*batch n_q n_a"]:
        """dq/da [rad/rad]: the joint rows of ``J_m``."""
        return self.manipulation_jacobian[..., : self.n_q, :]

    @property
    def object_jacobian(self) -> Float[Tensor, "*batch 6 n_a"]:
        """d(o, phi)/da: rows x, y, z [m/rad], then rotation [rad/rad], hand axes."""
        return self.manipulation_jacobian[..., self.n_q :, :]

    @property
    def described_jacobian(self) -> Float[Tensor, "*batch n_s n_a"]:
        """J_m of the hand as described."""
        return self.manipulation_jacobian if self.described is None else self.described

    @cached_property
    def lever(self) -> Float[Tensor, "*batch"]:
        """Distance of the contacts from the object's point, root mean square [m]."""
        arms = self.contacts.point - self.state.position[..., None, :]
        return (arms * arms).sum(-1).mean(-1).sqrt()

    @property
    def margins(self) -> Float[Tensor, "*batch n_c"]:
        """``mu_s f_n - |f_t|`` of each contact [N]."""
        return self.forces.margin

    @property
    def described_normal_sensitivity(self) -> Float[Tensor, "*batch n_c n_a"]:
        """d f_n/da of the model [N/rad]."""
        return self.normal_force_sensitivity if self.described_normal is None else self.described_normal

    def with_normal_sensitivity(self, normal: Float[Tensor, "n_c n_a"]) -> Linearization:
        """The same with another ``df_n/da`` [N/rad]; the force vectors follow."""
        correction = normal - self.normal_force_sensitivity
        dmu = self.contact_force_sensitivity.index_add(
            -2, torch.tensor(self.normal_rows), correction.to(self.contact_force_sensitivity)
        )
        return dataclasses.replace(
            self,
            contact_force_sensitivity=dmu,
            normal_force_sensitivity=normal,
            described_normal=self.described_normal_sensitivity,
            force_vector_sensitivity=self.force_vector_sensitivity
            - self.contacts.normal[..., None] * correction[..., None, :],
        )

    def step(self, delta_a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_s"]:
        """``ds = J_m da``.

        Raises:
            ShapeError: ``delta_a`` does not have one entry per actuator.
            NonFiniteError: an entry is NaN or infinite.
        """
        return _times(self.manipulation_jacobian, self._increment(delta_a))

    def forces_after(self, delta_a: Float[Tensor, "*batch n_a"]) -> ExpectedForces:
        """What the contacts bear after an increment, as long as they stick: forces to first order.

        Raises:
            ShapeError, NonFiniteError: as of :meth:`step`.
        """
        da = self._increment(delta_a)
        one = da.dim() == 1 and self.manipulation_jacobian.dim() == 2
        plain = one and is_plain(da, self.manipulation_jacobian, self.forces.force)
        at = self._arrays if plain else self
        return in_torch(at._after(like(da, at.manipulation_jacobian)))

    def _after(self, da: AnyArray) -> ExpectedForces:
        dmu = _times(self.contact_force_sensitivity, da)
        ends = (*self.normal_rows[1:], dmu.shape[-1])
        dspin = zeros(dmu, *dmu.shape[:-1], self.contacts.n_c)
        for i, (row, end) in enumerate(zip(self.normal_rows, ends, strict=True)):
            if end - row == 4:  # a soft finger
                dspin[..., i] = dmu[..., row + 3]
        df = _times(self.force_vector_sensitivity, da[..., None, :])
        normal = self.contacts.normal + _times(self.normal_motion, da[..., None, :])
        normal = normal / norm(normal)[..., None]
        force, spin = self.forces.force + df, self.forces.spin_moment + dspin
        f_n, margin = friction_use(self.contacts, force, spin, normal)
        covariance = self.forces.covariance
        if covariance is None:
            covariance = start_covariance(self.contacts.normal, self.options.forces)
        covariance = covariance + drift(df, dspin)[..., None] * eye(da, covariance.shape[-1])
        return of_fields(
            ExpectedForces,
            finger=self.contacts.finger,
            force=force,
            spin_moment=spin,
            normal=f_n,
            margin=margin,
            covariance=covariance,
        )

    def margins_after(self, delta_a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_c"]:
        """``mu_s f_n' - |u'|`` of each contact [N], f' from :meth:`forces_after`; below 0 it will slip.

        Raises:
            ShapeError, NonFiniteError: as of :meth:`step`.
        """
        return self.forces_after(delta_a).margin

    def _increment(self, delta_a: Tensor) -> Tensor:
        delta_a = as_tensors(delta_a=delta_a)[0].to(self.manipulation_jacobian)
        check_last("delta_a", delta_a, self.manipulation_jacobian.shape[-1], "one entry per actuator")
        check_finite("delta_a", delta_a)
        return delta_a


def sensitivities(
    kin: ContactKinematics,
    forces: GraspForces,
    J: Float[AnyArray, "*batch n_s n_a"],
    dmu: Float[AnyArray, "*batch n_h n_a"],
) -> dict[str, Any]:
    """Fields of a :class:`~torch_ekm.model.Linearization` that follow from J_m and dmu/da."""
    df, dn = force_change(kin, dmu), normal_motion(kin, J)
    normal = -(kin.contacts.normal[..., None, :] @ df + forces.force[..., None, :] @ dn)[..., 0, :]
    found = {
        "manipulation_jacobian": J,
        "contact_force_sensitivity": dmu,
        "normal_force_sensitivity": normal,
        "force_vector_sensitivity": df,
        "normal_motion": dn,
    }
    tensors = {name: torch.as_tensor(part) for name, part in found.items()}
    return {**tensors, "normal_rows": tuple(kin.normal_rows)}


def normal_motion(
    kin: ContactKinematics, J: Float[AnyArray, "*batch n_s n_a"]
) -> Float[AnyArray, "*batch n_c 3 n_a"]:
    """``d n_i/da = w_o x n_i + K_o sdot_i``, ``sdot_i = M_i (w_rel x n_i)``: turning of the normals."""
    w_o = J[..., None, -3:, :]
    w_rel = kin.relative_spin @ J[..., None, :, :]
    return -(kin.normal_hat @ w_o) - (kin.contacts.object_curvature @ kin.roll) @ w_rel


def force_change(
    kin: ContactKinematics, dmu: Float[AnyArray, "*batch n_h n_a"]
) -> Float[AnyArray, "*batch n_c 3 n_a"]:
    """``C_i dmu_i``: change of the force vectors in hand axes."""
    n_c, (*batch, _, n_a) = kin.contacts.n_c, dmu.shape
    full = zeros(dmu, *batch, 6 * n_c, n_a)
    full[..., kin.row_index, :] = dmu
    return kin.frame @ full.reshape(*batch, n_c, 6, n_a)[..., :3, :]


@runtime_checkable
class FollowedFigures(Protocol):
    """Figures of a hand, which J_m follows."""

    learns: bool
    """They adapt."""

    def solve(self, equations: MotionEquations) -> Motion | None:
        """J_m with the present figures; None: that of the description holds."""

    def present(self, described: Drives) -> tuple[Tensor, Drives]:
        """Change of the springs against the description [N m/rad], and the drives."""
        ...

    def pulled(self, moved: Tensor) -> Tensor:
        """What the tendons do when the motors do this [rad]."""
        ...

    def learn(self, lin: Linearization, moved: Tensor, increment: Tensor) -> object:
        """Learn from one motion."""


def _times(matrix: Any, vector: Any) -> Any:
    return (matrix @ vector[..., None])[..., 0]
