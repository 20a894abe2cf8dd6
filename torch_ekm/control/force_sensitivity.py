"""How the normal forces of the pads answer to the actuators, corrected by what was measured."""

from __future__ import annotations

import torch
from torch import nn

from .._checks import check_finite, check_shape
from .._recorded import Recorded
from ..typing import Float, Tensor

_PRIOR_STD = 20.0  # [N/rad] of an entry of B
_NOISE_STD = 0.25  # [N] of a change of force that B does not explain, at least
_TRUSTED_STD = 0.3  # [N] of what B does not explain; B counts less above it
_FORGETTING = 0.97  # of what earlier motions say in the direction of a new one
_RECENT = 0.1  # weight of the last motion in the variance of r
_CLIP = 4.0  # standard deviations; a contact that slips says nothing of the rest


class ForceSensitivity(Recorded, nn.Module):
    """``f_n+ - f_n = (df_n/da + B) w + noise``: B ``(n_pads, n_a)``, by recursive least squares::

        r = (f_n+ - f_n) - (df_n/da + B) w               of each pad that measures
        D <- D - (1 - .97) D w w' D / (w' D w) + w w'    motions, forgotten in the direction of a new one
        B <- B + r k',  k = P w / s^2,  P = (D / s^2 + I / 20^2)^-1
        s^2 <- .9 s^2 + .1 max(r^2 - w' P w, .25^2)      what B does not explain: a pad that rubs teaches less

    B belongs to the hand: it is kept from grasp to grasp.

    Args:
        n_pads, n_a: contact pads and actuators of the hand.

    Source: least squares with directional forgetting, Kulhavy and Karny, IFAC World Congress (1984).
    """

    def __init__(self, n_pads: int, n_a: int) -> None:
        super().__init__()
        self.correction = nn.Buffer(torch.zeros(n_pads, n_a, dtype=torch.float64))
        """B [N/rad]."""
        self.evidence = nn.Buffer(torch.zeros(n_pads, n_a, n_a, dtype=torch.float64))
        """D, of the motions that each pad measured [rad^2]."""
        self.variance = nn.Buffer(torch.full((n_pads,), _NOISE_STD**2, dtype=torch.float64))
        """s^2 of each pad [N^2]."""

    @property
    def used(self) -> Float[Tensor, "n_pads n_a"]:
        """``min(1, (0.3 N / s)^4) B`` [N/rad]: small motions that follow the noise of a pad look as if its
        force did not answer."""
        return self.correction * (_TRUSTED_STD**4 / self.variance.square()).clamp(max=1.0)[:, None]

    @property
    def _covariance(self) -> Tensor:
        """P of each pad ``(n_pads, n_a, n_a)``."""
        prior = torch.eye(self.correction.shape[-1], dtype=torch.float64) / _PRIOR_STD**2
        return torch.linalg.inv(self.evidence / self.variance[:, None, None] + prior)

    @torch.no_grad()
    def update(
        self,
        moved: Float[Tensor, " n_a"],
        change: Float[Tensor, " n_pads"],
        described: Float[Tensor, "n_pads n_a"],
    ) -> Float[Tensor, " n_pads"]:
        """Learn from one motion.

        Args:
            moved: w, of the encoders [rad].
            change: ``f_n+ - f_n`` of each pad [N]; NaN: it does not measure, or does not touch.
            described: ``df_n/da`` of each pad by the model [N/rad].

        Returns:
            r [N], NaN where nothing was measured.

        Raises:
            ShapeError, NonFiniteError: nothing is changed.
        """
        n_pads, n_a = self.correction.shape
        for name, value, shape in (
            ("moved", moved, (n_a,)), ("change", change, (n_pads,)), ("described", described, (n_pads, n_a))
        ):  # fmt: skip
            check_shape(name, value, shape)
        check_finite("moved", moved)
        w = moved.to(self.correction)
        r = change.to(w) - (described.to(w) + self.correction) @ w
        known = ~r.isnan()
        if not bool(known.any()) or not bool(w.any()):
            return r
        doubt = (self._covariance @ w) @ w  # w' P w
        spread = (self.variance + doubt).sqrt()
        Dw = self.evidence @ w
        seen = (Dw @ w).clamp(min=torch.finfo(w.dtype).tiny)[:, None, None]
        forgotten = (1 - _FORGETTING) * Dw[:, :, None] * Dw[:, None, :] / seen
        self.evidence[known] += (torch.outer(w, w) - forgotten)[known]
        gain = self._covariance @ w / self.variance[:, None]
        bounded = r.clamp(-_CLIP * spread, _CLIP * spread)
        self.correction[known] += bounded[known, None] * gain[known]
        unexplained = (bounded.square() - doubt).clamp(min=_NOISE_STD**2)
        self.variance[known] += _RECENT * (unexplained - self.variance)[known]
        return r

    def extra_repr(self) -> str:
        return f"pads={len(self.correction)}, largest={float(self.correction.abs().max()):.3g} N/rad"
