"""What one step asks for, and how much of it is made: the paper's loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from .._noise import DEGREE
from ..kinematics.se3 import hat
from ..typing import Float, Tensor
from .situation import Situation

if TYPE_CHECKING:
    from .decision import Decision

_OFF_ROTATION, _OFF_TRAVEL = 1.5 * DEGREE, 2.5e-3  # [rad], [m] that a step may leave the focus
_CREEP = 1.0  # [N] of margin that may be missing where friction and weight are equal
_LEAST = 0.35  # of the largest step, that only a measured grip cuts further


@dataclass(frozen=True)
class LimitingFunction:
    """``dx_d = e min(gain, step/|e|, contact_travel/|v(e)|)``: keeps the direction, linear near the goal.

    v(e) is the way that the whole error would carry the contact that moves most. The limiting function of the
    E-KM paper (section III.B) is that of ``step``; the other two hold off noise and wide objects.
    """

    gain: float = 0.8
    """Share of a small focused error that one step asks for. A model that is right meets all of it,
    camera noise included; below 1 the loop averages the noise over some steps."""
    step: float = 2.5 * DEGREE
    """At most this much of the focused error is asked for [rad]; at 2.5 deg each direction's own step."""
    contact_travel: float | None = 1.2e-3
    """And no contact is asked to move farther than this [m]: a wide object turns in smaller steps.
    None: no such limit."""

    def __call__(self, error: Float[Tensor, " n_x"], travel: float = 0.0) -> Float[Tensor, " n_x"]:
        """dx_d.

        Args:
            error: e, focused error.
            travel: ``|v(e)|``, see :func:`contact_travel` [m].
        """
        size = self.steps(error, travel)
        return error * min(self.gain, 1 / size) if size > 0 else error

    def steps(self, error: Float[Tensor, " n_x"], travel: float = 0.0) -> float:
        """How many of the largest steps make up an error."""
        size = float(torch.linalg.vector_norm(error)) / self.step
        return size if self.contact_travel is None else max(size, travel / self.contact_travel)


def contact_travel(twist: Float[Tensor, " 6"], lever: Float[Tensor, "n_c 3"]) -> float:
    """``max_i |v + w x l_i|`` of contacts at l from the object's point o [m]."""
    v, w = twist.numpy().reshape(2, 3)
    carried = v + lever.numpy() @ hat(w).T
    return math.sqrt((carried * carried).sum(-1).max())


@dataclass(frozen=True)
class StepBound:
    """``phi = min(1, 1.5 deg/|w_off|, 2.5 mm/|v_off|, (m + c)/(m - m_after)), c = 1 N mu f/W``.

    phi is the share of a step that is made. w_off and v_off are the predicted rotation and translation off
    the focus; m_after the predicted friction margins. A contact that slides holds no weight W across its way:
    the heavier the object is for its grip, the less may be missing. The bound scales a step, and does not
    turn it: the same bounds as rows of the program lose objects where friction is low.

    A step is not cut below 0.35 of the largest one: standing still turns nothing. But a grip f is tightened
    first: below 0.75 of the wanted one steps become smaller, and at 0.55 of it, where pads measure it, there
    are none.
    """

    def share(self, decision: Decision, seen: Situation, asked: float) -> float:
        """phi of a step.

        Args:
            asked: its size in units of the largest.
        """
        grip = 1.0 if decision.grip is None else decision.grip.bears
        phi = max(min(self._share(decision, seen), grip), min(1.0, _LEAST / max(asked, 1e-9)))
        return phi if seen.fingertip_force is None else min(phi, grip)  # an estimate is no reason to wait

    def _share(self, decision: Decision, seen: Situation) -> float:
        lin, focus = decision.pieces[0].linearization, seen.focus
        off = (focus.off_matrix @ decision.predicted[-6:]).numpy()
        translation = focus.off_translation.numpy()
        rotation, travel = (math.sqrt(part @ part) for part in (off[~translation], off[translation]))
        phi = min(1.0, _OFF_ROTATION / max(rotation, 1e-12), _OFF_TRAVEL / max(travel, 1e-12))
        f_n = seen.normal_force(lin)
        if f_n is None or not lin.forces.solved:
            return phi
        friction = float(lin.contacts.friction.mean()) * float(f_n.max())
        spare = _CREEP * friction / max(seen.weight, 1e-3)
        before, after = lin.margins.numpy(), lin.margins_after(decision.delta_a).numpy()
        missing = after < -spare
        allowed = (before[missing] + spare) / (before[missing] - after[missing])
        return min(phi, float(np.clip(allowed, 0.0, 1.0).min(initial=1.0)))
