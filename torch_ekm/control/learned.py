"""All that a closed loop learns, in one place: to be taken back, or kept while it works."""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Mapping
from typing import Any

from torch import nn

from ..exceptions import NoStateError
from .controller import LookAndMoveController
from .knowledge import HandKnowledge


class Learned:
    """Knowledge of the hand and learner; a learner without a state of its own is left out.

    Args:
        knowledge: of the hand.
        controller: has the learner.
    """

    def __init__(self, knowledge: HandKnowledge, controller: LookAndMoveController) -> None:
        self._parts: dict[str, nn.Module] = {"knowledge": knowledge}
        if controller.enhanced is not None:
            self._parts["learner"] = controller.enhanced.learner

    def state(self) -> dict[str, Any]:
        """What is known now, as state dicts that change no more."""
        found = {}
        for name, part in self._parts.items():
            with contextlib.suppress(NoStateError):
                found[name] = copy.deepcopy(part.state_dict())
        return found

    def restore(self, state: Mapping[str, Any]) -> None:
        """Know what was known when :meth:`state` was asked of this."""
        for name, part in self._parts.items():
            if name in state:  # not the part's own method: a change that is not yet is no count below 0
                nn.Module.load_state_dict(part, state[name])

    def load(self, state: Mapping[str, Any]) -> None:
        """Know what another one knew; all or nothing.

        Raises:
            StateMismatchError: it is that of other parts.
        """
        before = self.state()
        try:
            for name, part in self._parts.items():
                if name in state:
                    part.load_state_dict(state[name])
        except Exception:
            self.restore(before)
            raise
