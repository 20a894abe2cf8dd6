"""What a plan must not do on its way, beside the limits of a single step."""

from __future__ import annotations

from dataclasses import dataclass

from ..control import Inequality, LinearizedModel, Situation


@dataclass(frozen=True)
class SlipLimit:
    """``m + (dm/da) u >= minimum`` of each contact, m as the way has it: soft, and outweighed by the goal.

    Contacts that stick bear what is asked of them, however much, so without it a plan may bend the fingers
    against each other.
    """

    minimum: float = 0.0
    """[N]"""
    penalty: float = 0.5
    """Per N that is missing, per motion."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Inequality | None:
        lin = model.kinematic
        if not lin.forces.solved:
            return None
        return Inequality(-lin.margin_sensitivity, lin.margins - self.minimum, 1.0, self.penalty)
