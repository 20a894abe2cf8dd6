"""How actuators, tendon springs and loops act on the joints where that changes with the posture."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from .._arrays import like, namespace
from ..description.hand import HandDescription
from ..typing import AnyArray, Array, Float, Tensor

_STEP = 1e-6  # [rad] of differences along the posture


class Arms(NamedTuple):
    """Of one posture, or a batch; None: nothing changes, there are no loops."""

    ratio: Float[AnyArray, "*batch n_a n_q"] | None = None
    """Moment arms as factors of those of the description."""
    closed: Float[AnyArray, "*batch n_l n_q"] | None = None
    """dc/dq of the loops."""

    def of(self, actuation: Float[AnyArray, "n_a n_q"]) -> Any:
        """Moment arms at the posture."""
        return actuation if self.ratio is None else actuation * like(torch.as_tensor(self.ratio), actuation)

    @property
    def varies(self) -> bool:
        return self.ratio is not None or self.closed is not None

    def one(self, k: int) -> Arms:
        """Of a state of a flat batch."""
        return Arms(*(None if part is None else part.reshape(-1, *part.shape[-2:])[k] for part in self))


SAME = Arms()
"""Those of the description."""


def arms_at(hand: HandDescription, q: Float[AnyArray, "*batch n_q"]) -> Arms:
    """At a posture, with derivatives where it asks for them."""
    lengths, loops = hand.lengths, hand.loops
    ratio = None if lengths.constant else over_posture(q, lengths.ratio)
    return Arms(ratio, None if loops is None else over_posture(q, loops.lengths.jacobian))


def bends(
    hand: HandDescription,
    q: Float[AnyArray, "*batch n_q"],
    actuation: Float[AnyArray, "n_a n_q"],
    lam: Float[AnyArray, "*batch n_a"],
    loop: Float[AnyArray, "*batch n_l"],
) -> Any:
    """``sum_i lam_i d2l_i/dq2 + sum_k nu_k d2c_k/dq2`` ``(*batch, n_q, n_q)``; 0 where no arm changes.

    ``actuation`` is J_a of the description, ``loop`` nu, the forces of the loops.
    """
    parts = [] if hand.lengths.constant else [(hand.lengths, lam, actuation)]
    if hand.loops is not None and loop.shape[-1]:
        typical = like(torch.from_numpy(hand.loops.lengths.typical).to(torch.as_tensor(q)), q)
        parts.append((hand.loops.lengths, loop, typical))
    total: Any = 0.0
    for lengths, force, arms in parts:
        D = namespace(q).einsum("...i,ij,...ijk->...jk", force, arms, over_posture(q, lengths.slope))
        total = total + (D + D.mT) / 2
    return total


def over_posture(q: AnyArray, function: Callable[[Array], Array]) -> Any:
    """A function of the posture, with its derivative by central differences where q asks for it."""
    if not isinstance(q, Tensor):
        return function(q)
    at = q.detach().double().cpu().numpy()
    value = torch.from_numpy(function(at)).to(q)
    if q.requires_grad:
        shift = _STEP * np.eye(at.shape[-1])
        ahead, back = (function(at[..., None, :] + way) for way in (shift, -shift))
        slope = torch.from_numpy((ahead - back) / (2 * _STEP)).to(q)
        away = (q - q.detach()).reshape(*q.shape, *[1] * (value.dim() - q.dim() + 1))
        value = value + (away * slope).sum(q.dim() - 1)
    return value
