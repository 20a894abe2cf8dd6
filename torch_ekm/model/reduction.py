"""Permitted motions: rigid couplings, locked joints and the plane of a planar hand taken out; scaling."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import nn

from .._arrays import eye, like, namespace, norm, null_space, zeros
from ..contact.contacts import CHARACTERISTIC_LENGTH, ContactKinematics, ContactModel
from ..description.hand import HandDescription
from ..exceptions import SingularGraspError, UnstableGraspError
from ..typing import AnyArray, Bool, Float, Tensor
from .arms import SAME, Arms
from .grasp_forces import GraspForces
from .manipulation import KKTSolution, two_stage
from .options import ModelOptions


def sensitivities(
    kin: ContactKinematics,
    forces: GraspForces,
    J: Float[AnyArray, "*batch n_s n_a"],
    dmu: Float[AnyArray, "*batch n_h n_a"],
) -> dict[str, Any]:
    """Fields of a :class:`~torch_ekm.model.Linearization` that follow from J_m and dmu/da."""
    df, dn = force_change(kin, dmu), normal_motion(kin, J)
    normal = _of_normals(kin, forces, df, dn)
    found = {
        "manipulation_jacobian": J,
        "contact_force_sensitivity": dmu,
        "normal_force_sensitivity": normal,
        "margin_sensitivity": _of_margins(kin, forces, dmu, df, dn, normal),
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


def _of_normals(
    kin: ContactKinematics, forces: GraspForces, df: AnyArray, dn: AnyArray
) -> Float[AnyArray, "*batch n_c n_a"]:
    """``d f_n/da = n_in . df + f . d n_in`` [N/rad]; ``dn`` from :func:`normal_motion`."""
    normal, force = kin.contacts.normal[..., None, :], forces.force[..., None, :]
    return -(normal @ df + force @ dn)[..., 0, :]


def _of_margins(
    kin: ContactKinematics, forces: GraspForces, dmu: AnyArray, df: AnyArray, dn: AnyArray, normal: AnyArray
) -> Float[AnyArray, "*batch n_c n_a"]:
    """``d (mu_s f_n - |u|)/da``, ``u = [f_t; m_n mu_s/gamma]`` [N/rad]; ``d|u|`` counts as 0 at u = 0."""
    mu_s, gamma = kin.contacts.friction, kin.contacts.torsional_friction
    n_in = -kin.contacts.normal
    f_t = forces.force - forces.normal[..., None] * n_in
    df_t = df + forces.normal[..., None, None] * dn
    square, product = (f_t * f_t).sum(-1), (f_t[..., None, :] @ df_t)[..., 0, :]
    soft = [i for i, model in enumerate(kin.models) if model is ContactModel.SOFT_FINGER]
    if soft:
        at = [kin.normal_rows[i] + 3 for i in soft]
        scale2 = (mu_s[soft] / gamma[soft].clip(1e-9)) ** 2
        moment = forces.spin_moment[..., soft]
        square[..., soft] += scale2 * moment**2
        product[..., soft, :] += (scale2 * moment)[..., None] * dmu[..., at, :]
    xp = namespace(square)
    size = xp.sqrt(square)[..., None]
    slope = xp.where(size > 1e-9, product / size.clip(1e-9), 0.0)
    return mu_s[:, None] * normal - slope


_TWO_HARD = "two hard fingers cannot hold anything in space: write planar_normal, or torsional_friction"


GraspResponse = tuple[AnyArray, AnyArray, AnyArray, Any]
"""J_m ``(*batch, n_s, n_a)``, dmu/da ``(*batch, n_h, n_a)``, dlam/da ``(*batch, n_a, n_a)``, and the smallest
eigenvalue of the stiffness with the actuators locked ``(*batch)``."""


class Drives(NamedTuple):
    """How the actuators drive the joints."""

    actuation: Float[AnyArray, "n_a n_q"]
    """J_a: moment arms [rad/rad]."""
    stiffness: Float[AnyArray, " n_a"]
    """K_a [N m/rad]; infinite: rigid."""


class Reduction(nn.Module):
    """``ds = Z dz``: increments that couplings and the plane of motion allow, and the step within them.

    Rigid couplings ``C dq = 0`` and joints whose limits coincide leave ``n_z`` freedoms:
    ``D_zz = Z^T D Z``, ``A Z``, ``B Z``. Translations are scaled by L, forces by 1/L, so that all
    entries are in N m/rad before a rank is decided.

    Args:
        hand: the hand.
        options: whether the actuators are compliant.
        dtype: of the buffers.
    """

    def __init__(self, hand: HandDescription, options: ModelOptions, dtype: torch.dtype) -> None:
        super().__init__()
        self.actuators = hand.actuator_names
        joint = joint_basis(hand).to(dtype)
        pose = torch.eye(6, dtype=dtype)
        if hand.planar_normal is not None:
            pose = planar_pose_basis(torch.tensor(hand.planar_normal, dtype=dtype))
        self.joint_basis = nn.Buffer(joint, persistent=False)
        self.pose_basis = nn.Buffer(pose, persistent=False)
        self.basis = nn.Buffer(torch.block_diag(joint, pose), persistent=False)
        pose_scaled = pose.clone()
        pose_scaled[:3] *= CHARACTERISTIC_LENGTH
        self.scaled_basis = nn.Buffer(torch.block_diag(joint, pose_scaled), persistent=False)
        J_a = torch.as_tensor(hand.actuation_jacobian).to(dtype)
        self.actuation: Tensor = nn.Buffer(J_a, persistent=False)
        stiffness = torch.tensor([actuator.stiffness for actuator in hand.actuators], dtype=dtype)
        # next to a spring of 1 N m/rad a million is rigid to 1e-6, but drowns it in the tests of rank
        rigid = stiffness * J_a.square().sum(-1) > 1e6
        if not options.actuator_compliance:
            rigid = torch.ones_like(rigid)
        self.stiffness: Tensor = nn.Buffer(torch.where(rigid, torch.inf, stiffness), persistent=False)

    def solve(
        self,
        D: Float[AnyArray, "*batch n_s n_s"],
        A: Float[AnyArray, "*batch n_h n_s"],
        rows: list[int],
        held: Bool[AnyArray, "*batch n_q"],
        slack: Bool[AnyArray, "*batch n_a"],
        on_unstable: str,
        arms: Arms = SAME,
    ) -> GraspResponse:
        """J_m, dmu/da and dlam/da in full coordinates; states that differ in what is held are grouped.

        ```
        D' = Z^T D Z + B_c^T K_a B_c          compliant actuators stand in the stiffness
        E  = [A Z; B_r Z; e_j^T Z; dc/dq Z]   rigid rows: contacts, rigid actuators, held joints, loops
        ```

        Args:
            D, A: stiffness and constraint matrix.
            rows: which of the 6 n_c contact components are the rows of A.
            held: joints that do not move.
            slack: tendons that pull nothing.
            on_unstable: "raise" or "flag", as the option of this name.
            arms: at the posture.
        """
        if held.ndim == 1:
            return self._solve(D, A, rows, held, slack, on_unstable, arms)
        n_q, batch = held.shape[-1], held.shape[:-1]
        pattern = torch.cat([held, slack], dim=-1).reshape(-1, n_q + slack.shape[-1])
        own = arms.varies  # each state then has its own
        groups = pattern if own else torch.unique(pattern, dim=0)
        if not own and len(groups) == 1:
            return self._solve(D, A, rows, groups[0, :n_q], groups[0, n_q:], on_unstable)
        flat_D, flat_A = D.reshape(-1, *D.shape[-2:]), A.reshape(-1, *A.shape[-2:])
        parts: list[Tensor] = []
        for k, same in enumerate(groups):
            at = torch.arange(len(pattern)) == k if own else (pattern == same).all(-1)
            there = arms.one(k) if own else arms
            group = self._solve(flat_D[at], flat_A[at], rows, same[:n_q], same[n_q:], on_unstable, there)
            group = [torch.as_tensor(part) for part in group]
            parts = parts or [part.new_empty(len(pattern), *part.shape[1:]) for part in group]
            for whole, part in zip(parts, group, strict=True):
                whole[at] = part
        motion, contact, actuator, stability = (part.reshape(*batch, *part.shape[1:]) for part in parts)
        return motion, contact, actuator, stability

    @property
    def drives(self) -> Drives:
        """Those of the description."""
        return Drives(self.actuation, self.stiffness)

    def reduced(
        self,
        D: Any,
        A: Any,
        rows: list[int],
        held: Any,
        slack: Any,
        drives: Drives | None = None,
        arms: Arms = SAME,
    ) -> ReducedStep:
        """The equations in permitted coordinates z, scaled, of states in which the same joints are held.

        Arguments as of :meth:`solve`, held and slack of one state; ``drives`` in place of the description's.
        """
        J_a, K_a = (like(part, D) for part in self.drives) if drives is None else drives
        J_a = arms.of(J_a)
        n_a, n_q = J_a.shape
        n_h, L, S, xp = len(rows), CHARACTERISTIC_LENGTH, like(self.scaled_basis, D), namespace(D)
        D = _left(S, D @ S)
        row_scale = [1 / L if row % 6 < 3 else 1.0 for row in rows]
        row_scale = xp.asarray(row_scale, dtype=D.dtype, device=D.device)
        A = row_scale[:, None] * (A @ S)
        B = J_a @ S[:n_q]
        finite, taut = xp.isfinite(K_a), ~slack
        rigid, soft = (xp.where(which)[0] for which in (taut & ~finite, taut & finite))
        unit, F = eye(D, n_a), None
        if len(soft):
            K_B = K_a[soft, None] * B[soft]
            D = D + B[soft].mT @ K_B
            F = K_B.mT @ unit[soft]
        batch = D.shape[:-2]
        arm = xp.sqrt((B[rigid] ** 2).sum(-1)).clip(1e-12)[:, None]
        fixed = [B[rigid] / arm, S[:n_q][held]]
        if arms.closed is not None:
            rod = like(torch.as_tensor(arms.closed), D)
            fixed.append(rod / norm(rod).clip(1e-12)[..., None] @ S[:n_q])
        fixed = [part for part in fixed if len(part)]
        E = xp.concat([A, *(xp.broadcast_to(part, (*batch, *part.shape)) for part in fixed)], -2)
        R = zeros(D, E.shape[-2], n_a)
        R[n_h : n_h + len(rigid)] = unit[rigid] / arm
        return ReducedStep(D, E, R, F, row_scale, B, K_a, rigid, soft, arm)

    def _solve(
        self,
        D: AnyArray,
        A: AnyArray,
        rows: list[int],
        held: AnyArray,
        slack: AnyArray,
        on_unstable: str,
        arms: Arms = SAME,
    ) -> GraspResponse:
        system, n_h = self.reduced(D, A, rows, held, slack, arms=arms), len(rows)
        try:
            step = two_stage(
                system.D, system.E, system.R, system.F, on_unstable=on_unstable, actuators=self.actuators
            )
        except (SingularGraspError, UnstableGraspError) as error:
            if error.direction is not None:  # into state coordinates
                direction = self.scaled_basis @ error.direction
                error.direction = direction / torch.linalg.vector_norm(direction).clamp_min(1e-300)
                spatial = self.pose_basis.shape[-1] == 6 and all(row % 6 < 3 for row in rows)
                if spatial and len(rows) == 6 and float(error.direction[-3:].square().sum()) > 0.5:
                    error.args = (_TWO_HARD,)
            raise
        dlam = system.actuator_force(step, n_h)
        dmu = system.row_scale[:, None] * step.reaction[..., :n_h, :]
        S = like(self.scaled_basis, dmu)
        return _left(S.mT, step.motion), dmu, dlam, step.stability


class ReducedStep(NamedTuple):
    """``D dz + E^T dnu = F da``, ``E dz = R da`` in permitted, scaled coordinates."""

    D: Float[AnyArray, "*batch n_z n_z"]
    """Compliant actuators included."""
    E: Float[AnyArray, "*batch m n_z"]
    """Rows: contacts, rigid actuators in units of their arm, held joints."""
    R: Float[AnyArray, "m n_a"]
    F: Float[AnyArray, "n_z n_a"] | None
    row_scale: Float[AnyArray, " n_h"]
    B: Float[AnyArray, "n_a n_z"]
    stiffness: Float[AnyArray, " n_a"]
    rigid: AnyArray
    """Taut actuators without compliance."""
    soft: AnyArray
    """Taut actuators with it."""
    arm: Float[AnyArray, "n_rigid 1"]
    """Norm of the rows of B of the rigid ones."""

    def actuator_force(self, step: KKTSolution, n_h: int) -> Float[AnyArray, "*batch n_a n_a"]:
        """dlam/da of a solution; 0 of slack tendons."""
        n_a, J, rigid, soft = len(self.B), step.motion, self.rigid, self.soft
        dlam = zeros(J, *J.shape[:-2], n_a, n_a)
        dlam[..., rigid, :] = step.reaction[..., n_h : n_h + len(rigid), :] / self.arm
        if len(soft):
            pulled = _left(self.B[soft].mT, J) - eye(J, n_a)[soft]
            dlam[..., soft, :] = self.stiffness[soft, None] * pulled
        return dlam


def _left(S: AnyArray, X: AnyArray) -> Any:
    """``S^T X`` as one large product: torch folds a batch only into the left factor."""
    return (X.mT @ S).mT


def joint_basis(hand: HandDescription) -> Float[Tensor, "n_q n_z"]:
    """Orthonormal basis of the joint motions that the rigid couplings allow (float64)."""
    C = torch.as_tensor(hand.coupling, dtype=torch.float64).reshape(-1, hand.n_q)
    eye = torch.eye(hand.n_q, dtype=torch.float64)
    fixed = torch.as_tensor(hand.joint_upper <= hand.joint_lower)
    C = torch.cat([C, eye[fixed]])
    free = ~(C != 0).any(0)  # joints outside every coupling keep their own axis: the basis stays sparse
    coupled = (~free).nonzero()[:, 0]
    return torch.cat([eye[:, free], eye[:, coupled] @ null_space(C[:, coupled])], dim=1)


def planar_pose_basis(normal: Float[Tensor, " 3"]) -> Float[Tensor, "6 3"]:
    """Two translations in the plane and the rotation about its normal."""
    normal = normal / torch.linalg.vector_norm(normal)
    basis = torch.zeros(6, 3, dtype=normal.dtype)
    basis[:3, :2], basis[3:, 2] = null_space(normal[None]), normal
    return basis
