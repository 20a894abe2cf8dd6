"""How much of a step the model itself calls safe."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..exceptions import ParameterError
from ..typing import Float, Tensor
from .situation import Situation

if TYPE_CHECKING:
    from ..model import Linearization

_DEG = math.pi / 180


@dataclass(frozen=True)
class StepBound:
    """``phi = min(1, off_rotation/|w_off|, off_travel/|v_off|, (m + creep mu f/W)/(m - m_after),
    (f/f_wanted)^2, max(1/p, (f_i/(even f_mean))^2))``: the share of a step that is made.

    w_off and v_off are the predicted rotation and translation off the focus; m_after the predicted friction
    margins. A contact that slides holds no weight W across its way: the heavier the object is for its grip,
    the less may be missing. A grip f that falls short of the wanted one is tightened first. The fingers that
    oppose the strongest one may bear enough together while one of them lets go: steps p above those of
    pace 1, which change the forces faster than they are corrected, ask for a force f_i of each that is near
    the mean f_mean of them.

    A step is not cut below ``least`` of the largest one at pace 1: standing still turns nothing.
    """

    off_rotation: float = 1.5 * _DEG
    """[rad]"""
    off_travel: float = 2.5e-3
    """[m]"""
    creep: float = 1.0
    """Margin that may be missing where friction and weight are equal [N]."""
    even: float = 0.85
    """Of the mean of the fingers that oppose the strongest one, what each of them should bear."""
    least: float = 0.35
    """Infinite: steps are never cut."""

    def __post_init__(self) -> None:
        for name in ("off_rotation", "off_travel", "creep", "even", "least"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "greater than 0")

    def share(
        self,
        lin: Linearization,
        delta_a: Float[Tensor, " n_a"],
        predicted: Float[Tensor, " n_s"],
        seen: Situation,
        wanted: float | None,
        asked: float = 1.0,
    ) -> float:
        """phi of a step.

        Args:
            predicted: increment that the corrected model predicts for ``delta_a``.
            wanted: grip force of the finger that opposes the others [N]; None: no such wish.
            asked: p, size of the step in units of the largest at pace 1.
        """
        focus = seen.focus
        off = focus.off_matrix @ predicted[-6:]
        rotation = float(torch.linalg.vector_norm(off[~focus.off_translation]))
        travel = float(torch.linalg.vector_norm(off[focus.off_translation]))
        phi = min(1.0, self.off_rotation / max(rotation, 1e-12), self.off_travel / max(travel, 1e-12))
        f_n = seen.normal_force(lin)
        if f_n is None or not lin.forces.solved:
            return phi
        force = float(f_n.max())
        if wanted:
            others = np.delete(f_n, f_n.argmax())
            phi = min(phi, max(force / wanted, 0.0) ** 2)
            if len(others):
                even = max(float(others.min()), 0.0) / max(self.even * float(others.mean()), 1e-9)
                phi = min(phi, max(1 / max(asked, 1.0), even**2))
        friction = float(lin.contacts.friction.mean()) * force
        spare = self.creep * friction / max(seen.weight, 1e-3)
        before, after = lin.margins, lin.margins_after(delta_a)
        missing = after < -spare
        if bool(missing.any()):
            allowed = (before[missing] + spare) / (before[missing] - after[missing])
            phi = min(phi, float(allowed.clamp(0.0, 1.0).min()))
        return phi
