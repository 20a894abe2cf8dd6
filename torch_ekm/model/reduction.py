"""The quasi-static step of an elastic hand, in the two-stage form, within its permitted motions.

```
D ds + E^T dnu = F da        E = [A; B],  dnu = [dmu; dlam]
E ds           = R da        R = [0; I]
```

``F`` is 0 for rigid actuators and ``B^T K_a`` for compliant ones, whose rows then stand in D
(``D + B^T K_a B``) instead of in E. Rigid couplings, locked joints and the plane of a planar hand are taken
out, lengths scaled. All inputs may carry batch dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from .._arrays import eye, like, namespace, norm, null_space, zeros
from ..contact.contacts import CHARACTERISTIC_LENGTH
from ..description.hand import HandDescription
from ..exceptions import SingularGraspError, UnstableGraspError
from ..typing import AnyArray, Bool, Float, Tensor
from .stiffness import SAME, Arms

_RANK = 1e-8  # singular values of E below this share of the largest are zero
_STIFFNESS = 1e-9  # eigenvalues of N^T D N within this share of |D| are zero


@dataclass(frozen=True)
class KKTSolution:
    """Motion and reactions per unit motion of each actuator."""

    motion: Float[AnyArray, "*batch n n_a"]
    """J: ds = J da."""
    reaction: Float[AnyArray, "*batch m n_a"]
    """dnu/da, multipliers of the rows of E."""
    stability: Float[AnyArray, "*batch"] | np.float64
    """Smallest eigenvalue of sym(N^T D N), the stiffness with the actuators locked; inf if N is empty."""
    pinv: Float[AnyArray, "*batch n m"]
    """E^+."""
    null: Float[AnyArray, "*batch n n_free"]
    """N."""

    def adjoint(self, D: Float[AnyArray, "n n"], F: Float[AnyArray, "n k"]) -> tuple[AnyArray, AnyArray]:
        """y and nu of ``D^T y + E^T nu = F``, ``E y = 0``, on the null space that is known."""
        N = self.null
        y = 0 * F
        if N.shape[-1]:
            y = N @ namespace(N).linalg.solve((N.mT @ D @ N).mT, N.mT @ F)
        return y, -(self.pinv.mT @ (D.mT @ y - F))


def two_stage(
    D: Float[AnyArray, "*batch n n"],
    E: Float[AnyArray, "*batch m n"],
    R: Float[AnyArray, "... m n_a"],
    F: Float[AnyArray, "... n n_a"] | None = None,
    *,
    on_unstable: str = "raise",
    actuators: Sequence[str] = (),
) -> KKTSolution:
    """``J = P - N (N^T D N)^-1 N^T (D P - F)``, ``P = E^+ R``, ``N = null(E)``.

    Only the stiffness with the actuators locked, ``N^T D N``, is inverted, by LU: it is not symmetric
    for rolling and soft fingers. Redundant rows of E are allowed as long as they agree with R.

    Args:
        D: stiffness, in coordinates scaled so that its entries compare.
        E: rows that hold exactly.
        R: how fast each row is driven by each actuator; one for all states, or one for each.
        F: generalised forces of compliant actuators, per unit of da; one for all states, or one for each.
        on_unstable: "raise", or "flag" (return the formal answer; read ``stability``).
        actuators: their names, for messages.

    Raises:
        SingularGraspError: a motion without stiffness and constraint, or rigid actuators that
            contradict each other; the direction comes along. Independent of ``on_unstable``.
        UnstableGraspError: N^T D N has a negative eigenvalue: the grasp buckles.
    """
    xp = namespace(D)
    eps = xp.finfo(D.dtype).eps
    rank_tolerance, stiffness_tolerance = max(_RANK, 10 * eps), max(_STIFFNESS, 10 * eps)
    pinv, N = _range_and_null(E, rank_tolerance)
    P = pinv @ R
    lost = E @ P - R
    if 0 not in lost.shape and _largest(lost) > 10 * eps**0.5 * _largest(R):
        _raise_contradiction(torch.as_tensor(lost).detach(), torch.as_tensor(P), actuators)
    load = D @ P if F is None else D @ P - F
    stability = xp.full(D.shape[:-2], xp.inf, dtype=D.dtype, device=D.device)
    J = P
    if N.shape[-1]:
        K = N.mT @ D @ N
        values = xp.linalg.eigvalsh(0.5 * (K + K.mT))
        stability = values[..., 0]
        tolerance = stiffness_tolerance * _size(D)
        if bool((stability <= tolerance).any()):
            _judge(*map(torch.as_tensor, (K, N, stability, tolerance)), on_unstable=on_unstable)
        J = P - N @ xp.linalg.solve(K, N.mT @ load)
    unbalanced = D @ J if F is None else D @ J - F
    return KKTSolution(J, -(pinv.mT @ unbalanced), stability, pinv, N)


def _range_and_null(E: AnyArray, rank_tolerance: float) -> tuple[Any, Any]:
    """``E^+`` and an orthonormal null-space basis; QR where E has full row rank, else SVD."""
    (m, n), xp = E.shape[-2:], namespace(E)
    if m == 0:
        eye = xp.eye(n, dtype=E.dtype, device=E.device)
        return E.mT, xp.broadcast_to(eye, (*E.shape[:-2], n, n))
    if m <= n:
        Q, upper = xp.linalg.qr(E.mT, mode="complete")
        triangle = upper[..., :m, :]
        diagonal = abs(xp.diagonal(triangle, 0, -2, -1))
        if bool((xp.amin(diagonal, -1) > rank_tolerance * xp.amax(diagonal, -1)).all()):
            inverse = xp.linalg.inv(triangle)
            # |T^-1|_F |T|_F bounds the condition number from above
            cond = _size(inverse) * _size(triangle)
            if bool((cond < 1 / rank_tolerance).all()):
                return Q[..., :m] @ inverse.mT, Q[..., m:]
    U, sigma, Vh = xp.linalg.svd(E, full_matrices=True)
    rank = (sigma > rank_tolerance * sigma[..., :1].clip(1e-300)).sum(-1)
    r = int(rank.max())
    if int(rank.min()) != r:
        raise SingularGraspError("the states of a batch have constraints of different rank: treat them apart")
    pinv = (Vh[..., :r, :].mT / sigma[..., None, :r]) @ U[..., :r].mT
    return pinv, Vh[..., r:, :].mT


def _size(matrix: AnyArray) -> Any:
    """Frobenius norm."""
    return norm(matrix.reshape(*matrix.shape[:-2], -1))


def _largest(x: AnyArray) -> float:
    return float(abs(x.detach() if isinstance(x, Tensor) else x).max())


def _raise_contradiction(lost: Tensor, P: Tensor, actuators: Sequence[str]) -> None:
    worst = int(lost.abs().flatten(0, -2).amax(0).argmax())
    name = f"'{actuators[worst]}'" if actuators else str(worst)
    direction = P.flatten(0, -3)[0][:, worst] if P.dim() > 2 else P[:, worst]
    raise SingularGraspError(
        f"actuator {name} cannot move alone: contacts, couplings and the other rigid actuators forbid "
        f"it (rows violated by {float(lost.abs().max()):.2g}); there are more rigid actuators than mobility. "
        "Give the actuators a finite stiffness",
        direction=(direction / torch.linalg.vector_norm(direction).clamp_min(1e-300)).detach(),
    )


def _judge(K: Tensor, N: Tensor, stability: Tensor, tolerance: Tensor, *, on_unstable: str) -> None:
    """Name the worst direction of the worst state of a batch."""
    flat_K, flat_N = K.reshape(-1, *K.shape[-2:]), N.reshape(-1, *N.shape[-2:])
    spare = torch.linalg.svdvals(flat_K)[:, -1] - tolerance.reshape(-1)
    singular = float(spare.min()) <= 0
    if on_unstable == "flag" and not singular:
        return
    at = int((spare if singular else stability.reshape(-1)).argmin())
    value = float(stability.reshape(-1)[at])
    if singular:
        direction = (flat_N[at] @ torch.linalg.svd(flat_K[at])[2][-1]).detach()
    else:
        _, vectors = torch.linalg.eigh(0.5 * (flat_K[at] + flat_K[at].mT))
        direction = (flat_N[at] @ vectors[:, 0]).detach()
    if singular or abs(value) <= float(tolerance.reshape(-1)[at]):
        whose, remedy = "the joints", "give them a spring, or a lock"
        if float(direction[-6:].square().sum()) > 0.5:  # a unit vector: mostly of the object's twist
            whose = "the object"
            remedy = "its contacts leave it free, as before a loss: add contacts, or torsional friction"
        raise SingularGraspError(
            f"a motion of {whose} meets neither stiffness nor constraint (eigenvalue {value:.2g}); {remedy}",
            direction=direction,
        )
    raise UnstableGraspError(
        f"the stiffness with locked actuators has the eigenvalue {value:.3g} <= 0: the grasp buckles "
        "along the direction given; grip less hard or place the fingers wider",
        stiffness=value,
        direction=direction,
    )


_TWO_HARD = "two hard fingers cannot hold anything in space: write planar_normal, or torsional_friction"


GraspResponse = tuple[AnyArray, AnyArray, Any]
"""J_m ``(*batch, n_s, n_a)``, dmu/da ``(*batch, n_h, n_a)``, and the smallest eigenvalue of the stiffness
with the actuators locked ``(*batch)``."""


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
        compliant: False takes all actuators for rigid.
        dtype: of the buffers.
    """

    def __init__(self, hand: HandDescription, compliant: bool, dtype: torch.dtype) -> None:
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
        if not compliant:
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
        """J_m and dmu/da in full coordinates; states that differ in what is held are grouped.

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
        motion, contact, stability = (part.reshape(*batch, *part.shape[1:]) for part in parts)
        return motion, contact, stability

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
        dmu = system.row_scale[:, None] * step.reaction[..., :n_h, :]
        S = like(self.scaled_basis, dmu)
        return _left(S.mT, step.motion), dmu, step.stability


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
