from __future__ import annotations

import torch
from torch import nn

from ..description import HandDescription
from ..exceptions import ShapeError
from ..typing import Float, Tensor
from .null_space import null_space


class ActuationMap(nn.Module):
    r"""``a = a_0 + J_a q`` with the rigid couplings ``C (q - q_0) = 0``.

    Free-motion inverse: of all postures with these actuator positions, the one of least spring energy,

    ``q(a) = argmin 1/2 (q - q0)^T K_s (q - q0)   s.t.  J_a q = a - a_0,  C (q - q0) = 0``,

    which is affine in ``a``: ``q(a) = q0 + P (a - a_0 - J_a q0)``. Joint stops are not in it. With equal
    springs a distal tendon splits evenly, as iKin assumes for the iCub. Angles [rad].

    Args:
        hand: the hand.
        dtype: of the buffers; change it later with ``.to()``.
    """

    J_a: Float[Tensor, "n_a n_q"]
    """da/dq, constant moment arms."""
    C: Float[Tensor, "n_k n_q"]
    """Rigid couplings and locked joints."""
    free_motion: Float[Tensor, "n_q n_a"]
    """P = dq/da of the hand that touches nothing: ``J_a P = I``, ``C P = 0``."""
    null: Float[Tensor, "n_q n_free"]
    """Orthonormal basis of ``null([J_a; C])``: what springs and contacts alone decide."""
    _offset: Tensor
    _rest: Tensor

    def __init__(self, hand: HandDescription, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.hand = hand
        J_a, C = torch.from_numpy(hand.actuation_jacobian), torch.from_numpy(hand.coupling)
        K_s = torch.diag(torch.from_numpy(hand.spring_stiffness))
        B = torch.cat([J_a, C])
        N = null_space(B)
        P = torch.linalg.pinv(B)[:, : hand.n_a]
        if N.shape[-1]:  # remove from P what the springs would not do by themselves
            P = P - N @ torch.linalg.solve(N.mT @ K_s @ N, N.mT @ K_s @ P)
        offset, rest = torch.from_numpy(hand.actuator_offset), torch.from_numpy(hand.spring_rest)
        parts = {"J_a": J_a, "C": C, "free_motion": P, "null": N, "_offset": offset, "_rest": rest}
        for name, value in parts.items():
            self.register_buffer(name, value.to(dtype, copy=True), persistent=False)

    def actuators(self, q: Float[Tensor, "*batch n_q"]) -> Float[Tensor, "*batch n_a"]:
        """``a = a_0 + J_a q`` [rad].

        Raises:
            ShapeError: the last dimension is not ``n_q``; the message lists the joints.
        """
        self._check("q", q, self.hand.joint_names)
        return self._offset + (self.J_a @ q[..., None])[..., 0]

    def joints(self, a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_q"]:
        """Posture of the hand that touches nothing [rad].

        Raises:
            ShapeError: the last dimension is not ``n_a``; the message lists the actuators.
        """
        self._check("a", a, self.hand.actuator_names)
        excess = a - self.actuators(self._rest)
        return self._rest + (self.free_motion @ excess[..., None])[..., 0]

    def _check(self, name: str, value: Tensor, names: tuple[str, ...]) -> None:
        if value.dim() == 0 or value.shape[-1] != len(names):
            hint = f"in order: {', '.join(names)}"
            raise ShapeError(name, f"(*batch, {len(names)})", value.shape, hint)

    def extra_repr(self) -> str:
        free = self.null.shape[-1]
        return f"'{self.hand.name}', actuators={self.hand.n_a}, couplings={len(self.C)}, free={free}"
