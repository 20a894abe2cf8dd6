from __future__ import annotations

import numpy as np
import torch
from torch import nn

from ..description import HandDescription
from ..exceptions import ShapeError
from ..typing import Float, Tensor
from .equilibrium import FreeHand, Rest


class ActuationMap(nn.Module):
    r"""``a = a_0 + l(q)``, and where a hand that touches nothing rests with its motors at a:

    ``q(a) = argmin V_s(q) + 1/2 sum_i k_i (a_i - a_0i - l_i(q))^2``,

    within the joint stops, with the rigid couplings and loops that the description has. V_s is the energy of
    the springs; tendons only pull, rigid drives have ``a = a_0 + l(q)``. With constant moment arms and equal
    springs a distal tendon splits evenly, as iKin assumes for the iCub. Angles [rad].

    Args:
        hand: the hand.
        dtype: of the answers; change it later with ``.to()``.
    """

    J_a: Float[Tensor, "n_a n_q"]
    """Moment arms of the description, typical ones where they change with the posture."""

    def __init__(self, hand: HandDescription, dtype: torch.dtype = torch.float64) -> None:
        super().__init__()
        self.hand = hand
        self.register_buffer("J_a", torch.from_numpy(hand.actuation_jacobian).to(dtype), persistent=False)
        self._free = FreeHand(hand)

    def actuators(self, q: Float[Tensor, "*batch n_q"]) -> Float[Tensor, "*batch n_a"]:
        """``a = a_0 + l(q)`` [rad]: of tendons that are not stretched.

        Raises:
            ShapeError: the last dimension is not ``n_q``; the message lists the joints.
        """
        self._check("q", q, self.hand.joint_names)
        hand, at = self.hand, q.detach().double().cpu().numpy()
        arms = hand.lengths.jacobian(at, hand.actuation_jacobian)
        return _along(q, at, hand.unloaded(at), arms)

    def joints(self, a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_q"]:
        """Posture of the hand that touches nothing [rad].

        Raises:
            ShapeError: the last dimension is not ``n_a``; the message lists the actuators.
            EquilibriumError: none was found.
        """
        at, found = self._rests(a)
        q = np.array([rest.q for rest in found]).reshape(*at.shape[:-1], -1)
        P = np.array([rest.projector for rest in found]).reshape(*q.shape, -1)
        return _along(a, at, q, P)

    def free_motion(self, a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_q n_a"]:
        """P = dq/da of the hand that touches nothing; 0 for slack tendons and joints at their stops.

        Raises:
            ShapeError, EquilibriumError: as :meth:`joints`.
        """
        at, found = self._rests(a)
        P = np.array([rest.projector for rest in found])
        return torch.from_numpy(P.reshape(*at.shape[:-1], *P.shape[-2:])).to(self.J_a)

    def pull(self, a: Float[Tensor, "*batch n_a"]) -> Float[Tensor, "*batch n_a"]:
        """Force of each actuator along +a in the hand that touches nothing [N m]; 0 of slack tendons.

        Raises:
            ShapeError, EquilibriumError: as :meth:`joints`.
        """
        at, found = self._rests(a)
        return torch.from_numpy(np.array([rest.pull for rest in found]).reshape(at.shape)).to(self.J_a)

    def _rests(self, a: Tensor) -> tuple[np.ndarray, list[Rest]]:
        self._check("a", a, self.hand.actuator_names)
        at = a.detach().double().cpu().numpy()
        return at, [self._free(one) for one in at.reshape(-1, at.shape[-1])]

    def _check(self, name: str, value: Tensor, names: tuple[str, ...]) -> None:
        if value.dim() == 0 or value.shape[-1] != len(names):
            hint = f"in order: {', '.join(names)}"
            raise ShapeError(name, f"(*batch, {len(names)})", value.shape, hint)

    def extra_repr(self) -> str:
        return f"'{self.hand.name}', actuators={self.hand.n_a}, joints={self.hand.n_q}"


def _along(x: Tensor, at: np.ndarray, value: np.ndarray, slope: np.ndarray) -> Tensor:
    """The value at x, with its derivative."""
    found = torch.from_numpy(value).to(x)
    if x.requires_grad:
        away = x - torch.from_numpy(at).to(x)
        found = found + (torch.from_numpy(slope).to(x) @ away[..., None])[..., 0]
    return found
