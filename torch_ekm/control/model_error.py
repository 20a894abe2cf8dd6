"""How far motions end from where a model predicts them, as a share of the way."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from .._recorded import Recorded, bound_problems
from ..typing import Float, Tensor

_START = 0.07, 0.2  # along and across, of a hand of which nothing is known
_RECENT = 0.25  # weight of the last motion,
_WHOLE = math.radians(2.5)  # if it is as long as this [rad]
_SLIP, _LOSS, _MOST = 0.5, 1.5, 3.0  # [N] by which is gripped tighter, and at most
_FORGETS = 0.7  # share of it that is left in the next turn
STEADY = math.radians(0.4)  # [rad] of a motion as measured: two poses, and a pad that creeps as it settles


class ModelError(Recorded, nn.Module):
    """``s_i^2 <- s_i^2 + c (clip((e_i^2 - n^2) / way^2, 0, 1) - s_i^2), c = min(1, (way/2.5 deg)^2) / 4``.

    e is the rotation of the object that a model of ``f + g`` did not predict: along its way, and across.
    n = 0.4 deg is the part that has nothing to do with the way. Two figures for a hand and what it holds: for
    slides, figures that are not known, terms that the model leaves out. Variances of figures and of g are
    added where they are known.
    """

    def __init__(self) -> None:
        super().__init__()
        self.square = nn.Buffer(torch.tensor([along**2 for along in _START], dtype=torch.float64))
        """s^2, along and across."""
        self.tighter = nn.Buffer(torch.zeros((), dtype=torch.float64))
        """Grip on top of what suits the object, which has slid or was lost [N]."""

    @property
    def along(self) -> float:
        """s of the rotation about its own axis."""
        return math.sqrt(float(self.square[0]))

    @property
    def across(self) -> float:
        """s of the rotation off it."""
        return math.sqrt(float(self.square[1]))

    def begin(self) -> None:
        """A new turn: what slid in the last one is no part of it."""
        self.square.copy_(torch.minimum(self.square, self.square.new_tensor(_START).square()))
        self.tighter *= _FORGETS

    def slid(self, lost: bool = False) -> None:
        """The object has slid in the fingers, or is lost: it is gripped tighter."""
        self.tighter.copy_((self.tighter + (_LOSS if lost else _SLIP)).clamp(max=_MOST))

    def see(self, error: Float[Tensor, " 3"], way: Float[Tensor, " 3"]) -> None:
        """Learn from one movement.

        Args:
            error: e, measured less predicted [rad].
            way: predicted rotation [rad].
        """
        size = float(torch.linalg.vector_norm(way))
        if size == 0:
            return
        along = float(error @ way) / size
        across = max(float(error @ error) - along**2, 0.0) / 2  # of each of two directions
        found = self.square.new_tensor([along**2, across])
        share = ((found - STEADY**2) / size**2).clamp(0, 1)
        self.square += _RECENT * min(1.0, (size / _WHOLE) ** 2) * (share - self.square)

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        return bound_problems(state, square=(0, 1), tighter=(0, _MOST))

    def extra_repr(self) -> str:
        return f"along={self.along:.2g}, across={self.across:.2g}"
