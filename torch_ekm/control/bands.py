"""How sure a model is of where a movement leads."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..kinematics import GraspState
from ..typing import Array
from .decision import Band, Piece
from .model_error import NOISE

if TYPE_CHECKING:
    from ..plant import Observation
    from .controller import LookAndMoveController
    from .focus import PoseTarget
    from .knowledge import HandKnowledge

_DEG = math.pi / 180
_LEVER = 0.03  # [m]: a share of a rotation counts as much as that share of this translation
_SHARE = 0.15  # of the way that a normal force has come: what the model does not know of it


class Bands:
    """Standard deviations along a path, from its beginning::

        Sigma = G P G' + (sum sd_g)^2 + s^2 way^2 + n^2,   G = sum d(J_m w)/d figures
        sd_f^2 = s_f^2 + u' P_f u + (0.15 sum |df_n|)^2

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
        self._start, n_pads = seen.state, len(controller.kinematic.hand.pads)
        self._force = seen.fingertip_force
        self._figures = np.zeros((6, 0))
        self._g, self._way = np.zeros(6), np.zeros(3)
        self._pull = torch.zeros_like(seen.a)
        self._said = torch.zeros(n_pads, dtype=torch.float64)  # S w
        self._swing = torch.zeros(n_pads, dtype=torch.float64)  # sum |df|
        self._pads: list[int] | None = None

    def add(self, piece: Piece, state: GraspState) -> Band:
        """One more piece, which leads to a state."""
        controller, hand = self._controller, self._controller.kinematic.hand
        twist, lin = piece.increment[-6:].numpy(), piece.linearization
        self._way = self._way + twist[3:]
        self._pull = self._pull + piece.action
        if controller.enhanced is not None:
            _, variance = controller.enhanced.correction(piece.state, piece.action, state.n_s)
            self._g += variance[-6:].sqrt().numpy()
        cov = np.diag(self._g**2)
        figures = self._knowledge.figures
        slopes = None if controller.enhanced is None else figures.twist_slopes(lin, piece.action)
        if slopes is not None:
            self._figures = self._figures + slopes if self._figures.size else slopes
            cov += self._figures @ self._knowledge.figures.covariance.numpy() @ self._figures.T
        cov += self._of_model()
        focus = controller.focus
        rows = focus.off_matrix[~focus.off_translation].numpy()
        off_std = (
            math.sqrt(max(float(np.linalg.eigvalsh(rows @ cov @ rows.T)[-1]), 0.0)) if len(rows) else 0.0
        )
        off = focus.off_rotation(self._target.error(state))
        force = force_std = None
        if self._force is not None and piece.force is not None:
            rows_, pads = hand.pad_rows(lin.contacts.finger)
            if self._pads is None:
                self._pads, self._last = pads, self._force
            self._said[pads] += (lin.described_normal_sensitivity @ piece.action)[rows_]
            self._swing += (piece.force - self._last).abs().nan_to_num()
            self._last = piece.force
            known = torch.zeros(len(self._said), dtype=torch.bool)
            known[self._pads] = True
            force = piece.force.nan_to_num().where(known, torch.nan)
            spread = self._knowledge.forces.spread(self._pull, self._said)
            force_std = (spread.square() + (_SHARE * self._swing).square()).sqrt()
        return Band(off, off_std, torch.from_numpy(np.sqrt(cov.diagonal())), force, force_std)

    def _of_model(self) -> Array:
        """Covariance of what neither figures nor g know: shares of the way, and noise."""
        error, size = self._knowledge.error, float(np.linalg.norm(self._way))
        axis = self._way / max(size, 1e-12)
        turn = (error.across * size) ** 2 * np.eye(3) + NOISE**2 * np.eye(3)
        turn += (error.along**2 - error.across**2) * size**2 * np.outer(axis, axis)
        shift = (_LEVER * error.across * size) ** 2 * np.eye(3) + (_LEVER * NOISE) ** 2 * np.eye(3)
        return np.block([[shift, np.zeros((3, 3))], [np.zeros((3, 3)), turn]])
