"""What the kinematic model says about one state: forces, and how everything answers to the actuators."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import torch

from .._arrays import as_tensors, eye, in_numpy, in_torch, is_plain, like, norm, of_fields, zeros
from .._checks import check_finite, check_last
from ..contact.contacts import ContactSet
from ..kinematics.poses import GraspState
from ..typing import AnyArray, Bool, Float, Tensor
from .grasp_forces import ExpectedForces, GraspForces, drift, friction_use, margin_std, start_covariance
from .motion_equations import Motion, MotionEquations
from .options import ModelOptions
from .reduction import Drives
from .validity import Doubt, ModelStatus


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
    actuator_force_sensitivity: Float[Tensor, "*batch n_a n_a"]
    """dlam/da [N m/rad]."""
    normal_force_sensitivity: Float[Tensor, "*batch n_c n_a"]
    """d f_n/da [N/rad], the turning of the normals included: rows for regulating the grip."""
    margin_sensitivity: Float[Tensor, "*batch n_c n_a"]
    """d margin/da [N/rad]."""
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
        """The same with another ``df_n/da`` [N/rad]; margins and force vectors follow."""
        correction = normal - self.normal_force_sensitivity
        mu_s, inward = self.contacts.friction[..., None], -self.contacts.normal[..., None]
        dmu = self.contact_force_sensitivity.index_add(
            -2, torch.tensor(self.normal_rows), correction.to(self.contact_force_sensitivity)
        )
        return dataclasses.replace(
            self,
            contact_force_sensitivity=dmu,
            normal_force_sensitivity=normal,
            described_normal=self.described_normal_sensitivity,
            margin_sensitivity=self.margin_sensitivity + mu_s * correction,
            force_vector_sensitivity=self.force_vector_sensitivity + inward * correction[..., None, :],
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
        f_n, margin, gradient = friction_use(self.contacts, force, spin, normal)
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
            actuator=-(self.forces.lam + _times(self.actuator_force_sensitivity, da)),
            covariance=covariance,
            margin_std=margin_std(self.contacts, f_n, gradient, covariance),
        )

    def margins_after(self, delta_a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_c"]:
        """``mu_s f_n' - |u'|`` of each contact [N], f' from :meth:`forces_after`; below 0 it will slip.

        ``margins + margin_sensitivity da`` to first order, but exact in the cone.

        Raises:
            ShapeError, NonFiniteError: as of :meth:`step`.
        """
        return self.forces_after(delta_a).margin

    def _increment(self, delta_a: Tensor) -> Tensor:
        delta_a = as_tensors(delta_a=delta_a)[0].to(self.manipulation_jacobian)
        check_last("delta_a", delta_a, self.manipulation_jacobian.shape[-1], "one entry per actuator")
        check_finite("delta_a", delta_a)
        return delta_a


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
