"""How far motions end from where a model predicts them, as a share of the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from .._recorded import Recorded, bound_problems

_START = 0.2  # of a hand of which nothing is known
_RECENT = 0.25  # weight of the last motion,
_WHOLE = math.radians(2.5)  # if it is as long as this [rad]
NOISE = math.radians(0.5)  # [rad] of a motion as measured: two poses, and a pad that creeps as it settles


class ModelError(Recorded, nn.Module):
    """``s^2 <- s^2 + c (clip((|e|^2 - 2 n^2) / way^2, 0, 1) - s^2), c = min(1, (way/2.5 deg)^2) / 4``.

    e is the rotation of the object that a model of ``f + g`` did not predict, n = 0.5 deg the part of it that
    has nothing to do with the way. One figure for a hand and what it holds: slides, figures that are not
    known, terms that the model leaves out. Variances of figures and of g are added where they are known.
    """

    def __init__(self) -> None:
        super().__init__()
        self.square = nn.Buffer(torch.tensor(_START**2, dtype=torch.float64))

    @property
    def share(self) -> float:
        """s."""
        return math.sqrt(float(self.square))

    def begin(self) -> None:
        """A new turn: what slid in the last one is no part of it."""
        self.square.clamp_(max=_START**2)

    def see(self, error: float, way: float) -> None:
        """Learn from one motion.

        Args:
            error: ``|e|`` [rad].
            way: predicted rotation [rad].
        """
        if way > 0:
            share = min(max(error**2 - 2 * NOISE**2, 0.0) / way**2, 1.0)
            self.square += _RECENT * min(1.0, (way / _WHOLE) ** 2) * (share - self.square)

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        return bound_problems(state, square=(0, 1))

    def extra_repr(self) -> str:
        return f"share={self.share:.2g}"
