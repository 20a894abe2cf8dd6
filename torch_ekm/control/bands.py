"""How sure a model is of where a movement leads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from .._noise import NOISE
from ..estimation.hand_figures import HandFigures
from ..kinematics import GraspState
from ..typing import Array, Float, Tensor
from .decision import Band, Piece
from .knowledge import STEADY

if TYPE_CHECKING:
    from ..description import HandDescription
    from ..model import Linearization
    from ..plant import Observation
    from .controller import LookAndMoveController
    from .focus import PoseTarget
    from .knowledge import HandKnowledge

DEVIATIONS = 2.0
"""At which a waypoint, and a piece from rest, is safe."""
_LEVER = 0.03  # [m]: a share of a rotation counts as much as that share of this translation
_SERVO = 0.05  # of its way, that a servo errs
_SHARE = 0.15  # of the way that a normal force has come: what the model does not know of it


def servo_std(lin: Linearization, w: Float[Tensor, " n_a"], rows: list[int]) -> Tensor:
    """``sqrt(sum_j (df_n/da_j sd_j)^2)``: what servos that err by ``sd_j`` change of normal forces [N].

    A finger of 20 N m/rad loses or gains several newtons in a degree of its motor, a soft one some tenths.
    """
    error = (NOISE.servo**2 + (_SERVO * w).square()).sqrt()
    return (lin.described_normal_sensitivity[rows] * error).square().sum(-1).sqrt()


def lets_go(hand: HandDescription, piece: Piece, deviations: float = DEVIATIONS) -> str:
    """Why servos that err may let a finger go in a piece that is made from rest; empty: they do not, or they
    change its force by less than pads err: springs hold it, and the next look finds it."""
    if piece.force is None:
        return ""
    lin = piece.linearization
    rows, pads = hand.pad_rows(lin.contacts.finger)
    errs = deviations * servo_std(lin, piece.action, rows)
    loose = (piece.force[pads] < errs) & (errs > NOISE.force)
    return "servos as stiff as these may let a finger go" if bool(loose.any()) else ""


class Bands:
    """Standard deviations along a path, from its beginning::

        Sigma = G P G' + (sum sd_g)^2 + s^2 way^2 + n^2,   G = sum d(J_m w)/d figures
        sd_f^2 = s_f^2 + u' P_f u + (0.15 sum |df_n|)^2 + servo_std^2

    of the object's motion: covariance P of the hand's figures, deviation sd_g of g, share s of
    :class:`ModelError` and noise n of a motion; of the normal forces: noise and covariance of
    :class:`ForceSensitivity`. All of it errs alike along a path, so deviations add up, not variances.
    """

    def __init__(
        self,
        controller: LookAndMoveController,
        knowledge: HandKnowledge,
        seen: Observation,
        target: PoseTarget,
    ) -> None:
        self._controller, self._knowledge, self._target = controller, knowledge, target
        n_pads = len(controller.kinematic.hand.pads)
        self._force = seen.fingertip_force
        self._slopes: Array | None = None  # G
        self._g, self._way, self._turned = np.zeros(6), np.zeros(3), 0.0
        self._pull = torch.zeros_like(seen.a)
        self._said = torch.zeros(n_pads, dtype=torch.float64)  # S w
        self._swing = torch.zeros(n_pads, dtype=torch.float64)  # sum |df|
        self._pads: list[int] | None = None

    def add(self, piece: Piece, state: GraspState) -> Band:
        """One more piece, which leads to a state."""
        controller, focus = self._controller, self._controller.focus
        self._way = self._way + piece.increment[-3:].numpy()
        self._turned += float(piece.increment[-3:].norm())
        self._pull = self._pull + piece.action
        covariance, figures = self._of_model(), self._knowledge.figures
        if controller.enhanced is not None:
            _, variance = controller.enhanced.correction(piece.state, piece.action, state.n_s)
            self._g += variance[-6:].sqrt().numpy()
            covariance += np.diag(self._g**2)
            slopes = figures.twist_slopes(piece.linearization, piece.action)
            if slopes is not None and isinstance(figures, HandFigures):
                self._slopes = slopes if self._slopes is None else self._slopes + slopes
                covariance += self._slopes @ figures.covariance.numpy() @ self._slopes.T
        rows = focus.off_matrix[~focus.off_translation].numpy()
        spread = np.linalg.eigvalsh(rows @ covariance @ rows.T).max(initial=0.0)
        off = focus.off_rotation(self._target.error(state))
        twist_std = torch.from_numpy(np.sqrt(covariance.diagonal()))
        return Band(off, math.sqrt(spread), twist_std, *self._of_forces(piece))

    def _of_forces(self, piece: Piece) -> tuple[Tensor | None, Tensor | None]:
        """Forces of the pads that touched at the start and their deviations; None: not measured."""
        if self._force is None or piece.force is None or piece.said is None:
            return None, None
        rows, pads = self._controller.kinematic.hand.pad_rows(piece.linearization.contacts.finger)
        self._pads = pads if self._pads is None else self._pads
        self._said += piece.said
        self._swing += (piece.force - self._force).abs().nan_to_num()
        self._force = piece.force
        force = torch.full_like(piece.force, torch.nan)
        force[self._pads] = piece.force.nan_to_num()[self._pads]
        spread = torch.full_like(force, NOISE.force)
        if self._controller.forces is not None:  # else nothing is learned of them
            spread = self._knowledge.forces.spread(self._pull, self._said, self._turned)
        servo = torch.zeros_like(spread)
        servo[pads] = servo_std(piece.linearization, self._pull, rows)
        return force, (spread.square() + servo.square() + (_SHARE * self._swing).square()).sqrt()

    def _of_model(self) -> Array:
        """Covariance of what neither figures nor g know: shares of the way, and noise."""
        error, size = self._knowledge.error, float(np.linalg.norm(self._way))
        axis = self._way / max(size, 1e-12)
        turn = (error.across * size) ** 2 * np.eye(3) + STEADY**2 * np.eye(3)
        turn += (error.along**2 - error.across**2) * size**2 * np.outer(axis, axis)
        shift = (_LEVER * error.across * size) ** 2 * np.eye(3) + (_LEVER * STEADY) ** 2 * np.eye(3)
        return np.block([[shift, np.zeros((3, 3))], [np.zeros((3, 3)), turn]])
