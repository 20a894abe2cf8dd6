"""Scores by which a full basis chooses the point to prune: the lowest goes.

Arguments, all ``(*batch, b)`` but the first: alpha ``(*batch, b, m)``, the diagonals of C, Q and W,
and the sample number of each point. With a, c, q, w a point's entries:
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from ...typing import Tensor


def _remaining(c: Tensor, q: Tensor) -> Tensor:
    return torch.maximum(c + q, 100 * torch.finfo(q.dtype).eps * q)


def kl_score(alpha: Tensor, c: Tensor, q: Tensor, w: Tensor, age: Tensor) -> Tensor:
    """``2 KL = |a|^2/(c+q) + m (w/q + ln(1 + c/q))``: exact loss of pruning it (Csato's thesis)."""
    rest = _remaining(c, q)
    return alpha.square().sum(-1) / rest + alpha.shape[-1] * (w / q + (rest / q).log())


def mean_score(alpha: Tensor, c: Tensor, q: Tensor, w: Tensor, age: Tensor) -> Tensor:
    """``|a|^2/(c+q)``: the loss in the mean alone (Csato & Opper 2002)."""
    return alpha.square().sum(-1) / _remaining(c, q)


def novelty_score(alpha: Tensor, c: Tensor, q: Tensor, w: Tensor, age: Tensor) -> Tensor:
    """``1/q``: variance of the point given the others."""
    return 1.0 / q


def oldest_score(alpha: Tensor, c: Tensor, q: Tensor, w: Tensor, age: Tensor) -> Tensor:
    """Sample number: a sliding window of basis points."""
    return age


PRUNING_SCORES: dict[str, Callable[[Tensor, Tensor, Tensor, Tensor, Tensor], Tensor]] = {
    "kl": kl_score,
    "mean": mean_score,
    "novelty": novelty_score,
    "oldest": oldest_score,
}
