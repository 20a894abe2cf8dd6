"""The quasi-static step of an elastic hand, in the two-stage form.

```
D ds + E^T dnu = F da        E = [A; B],  dnu = [dmu; dlam]
E ds           = R da        R = [0; I]
```

``F`` is 0 for rigid actuators and ``B^T K_a`` for compliant ones, whose rows then stand in D
(``D + B^T K_a B``) instead of in E. All inputs may carry batch dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from .._arrays import namespace, norm
from ..exceptions import SingularGraspError, UnstableGraspError
from ..typing import AnyArray, Float, Tensor

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
    if isinstance(D, Tensor) and (D.requires_grad or E.requires_grad):
        return _differentiable(D, E, R, F, on_unstable, actuators)
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


def _differentiable(
    D: Any, E: Any, R: Any, F: Any, on_unstable: str, actuators: Sequence[str]
) -> KKTSolution:
    """The same, with the derivative by the implicit function theorem: that of a null space is not defined.

    A second solve has the residual of both equations on its right-hand side, which is 0 and has a derivative.
    """
    D0, E0 = D.detach(), E.detach()
    load = R.new_zeros(D.shape[-1], R.shape[-1]) if F is None else F
    at = two_stage(D0, E0, R.detach(), load.detach(), on_unstable=on_unstable, actuators=actuators)
    J, nu = at.motion, at.reaction
    moved, loaded = R - E @ J, load - D @ J - E.mT @ nu
    change = two_stage(D0, E0, moved - moved.detach(), loaded - loaded.detach(), on_unstable="flag")
    return KKTSolution(J + change.motion, nu + change.reaction, at.stability, at.pinv, at.null)


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
