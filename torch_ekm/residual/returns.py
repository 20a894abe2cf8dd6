"""Regimes that come back: a learner's state before each change is kept, and taken again where it fits."""

from __future__ import annotations

import copy
from typing import Any, cast

import numpy as np
import torch
from torch import nn

from ..typing import AnyArray, Tensor
from .sparse_gp.monitor import COOL, DetectChanges
from .sparse_gp.part import Host
from .tails import FREEDOM

_KEPT = 2  # regimes
_EVERY = 64  # samples between two copies of the present state
_AT = 20  # samples before the first of them: little else is due then
_REST = 32  # samples after a change or a return in which there is neither a copy nor a return
_CALM = -0.5, 0.12  # level of DetectChanges at which a copy is of one regime alone
_MEMORY, _ENOUGH, _MOST = 0.9, 8.0, 10.0  # of log evidence: forgotten, that a regime is back, of one sample
_SURPRISE = 3.0  # nis from which on old regimes are asked


class Returns(nn.Module):
    """Old states of a learner that notes changes of the system, for a mixture of one model::

        a_j <- max(0, .9 a_j + min(10, c(mean)) - c(mean_j)),   c(mean) = sum 11/2 log(1 + z^2/10)

    c sums over the outputs, z is the error of the mixture's mean, or of the j-th state's, in the mixture's
    typical deviations. Where a_j exceeds 8 the learner and the j-th state change places: one or two samples
    suffice. A copy of the state is made every 64 samples while all goes well, so that a change, which is
    noticed samples later, does not spoil what is kept. Two regimes are kept; the older one goes.

    Args:
        learner: whose states are kept.
    """

    def __init__(self, learner: Host) -> None:
        super().__init__()
        self.states = nn.ModuleList(copy.deepcopy(learner) for _ in range(_KEPT + 1))  # the last: the copy
        self.reset()

    def reset(self) -> None:
        """No regime is known."""
        self.known: dict[str, Any] = {"is_copied": False, "n": 0, "rest": _REST, "evidence": []}

    def get_extra_state(self) -> dict[str, Any]:
        """What is known of the states: log evidence of each old one, and whether there is a copy."""
        return copy.deepcopy(self.known)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.known = copy.deepcopy(state)

    def observe(self, learner: Host, x: Tensor, y: AnyArray, said: AnyArray, nis: float) -> bool:
        """Take note of a sample that was learned; whether the learner is in an old state from now on.

        ``said``: mean of the mixture before, and its typical deviation, ``(2, out)``.
        """
        level = float(cast("DetectChanges", learner.part(DetectChanges)).level)
        changed = level == COOL  # at the last sample: the learner has started again
        known, evidence, rest = self.known, self.known["evidence"], max(self.known["rest"] - 1, 0)
        known["n"], known["rest"] = known["n"] + 1, rest
        due = known["n"] % _EVERY == _AT
        if not (changed or evidence or due):
            return False
        states = self.states
        if evidence and (nis > _SURPRISE or any(evidence)):
            j = self._judge(x, y, said)
            if evidence[j] > _ENOUGH and not rest:
                copy_state(states[_KEPT], learner)
                copy_state(learner, states[j])
                states[j], states[_KEPT] = states[_KEPT], states[j]
                known |= {"evidence": [0.0] * len(evidence), "is_copied": False, "rest": _REST}
                return True
        if changed and known["is_copied"]:
            kept, new, at = list(states[:_KEPT]), states[_KEPT], len(evidence)
            order = [*kept[:at], new, *kept[at:]] if at < _KEPT else [*kept[1:], new, kept[0]]
            for place, state in enumerate(order):
                states[place] = state
            known |= {"evidence": [0.0] * min(at + 1, _KEPT), "is_copied": False, "rest": _REST}
        elif due and not rest and _CALM[0] < level < _CALM[1]:
            known["is_copied"] = True
            copy_state(states[_KEPT], learner)
        return False

    def _judge(self, x: Tensor, y: AnyArray, said: AnyArray) -> int:
        """The state that fits best, after this sample."""
        most, evidence = min(_cost(y, said[0], said[1]), _MOST), self.known["evidence"]
        for j, before in enumerate(evidence):
            mean = self.states[j](x).cpu().numpy()
            evidence[j] = max(0.0, _MEMORY * before + most - _cost(y, mean, said[1]))
        return int(np.argmax(evidence))


def _cost(y: AnyArray, mean: AnyArray, deviation: AnyArray) -> float:
    z2 = ((y - mean) / deviation) ** 2
    return float(0.5 * (FREEDOM + 1.0) * np.log1p(z2 / FREEDOM).sum())


@torch.no_grad()
def copy_state(to: nn.Module, of: nn.Module) -> None:
    """All that a learner has learned, into another one of its make."""
    for new, old in zip(to.modules(), of.modules(), strict=True):
        for mine, his in zip(new.buffers(recurse=False), old.buffers(recurse=False), strict=True):
            mine.copy_(his)
        if type(old).get_extra_state is not nn.Module.get_extra_state:
            new.set_extra_state(old.get_extra_state())
