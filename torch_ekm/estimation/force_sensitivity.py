"""How the normal forces of the pads answer to the actuators, corrected by what was measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import nn

from .._checks import check_finite, check_kind, check_shape
from .._noise import NOISE
from .._recorded import Recorded, bound_problems, covariance_problems
from ..typing import Array, Float, Tensor
from .parameter_filter import update

_PRIOR_STD = 20.0  # [N/rad] of an entry of B
_WAY_STD = 10.0  # [N/rad] of an entry of l
_LARGEST_STD = 20.0  # [N] of a change of force that c and B do not explain
_LEAST_STD = 0.5 * NOISE.force  # [N] of a pad that does as c and B say
_MOST_EVIDENCE = 1e12  # [N^2]: no pad bears what would make more of it
_USUAL = 1 / 0.3**2 - 1  # information on theta that hands have in common, on top of the prior's
_GRASPS, _MOST_READ = 8, math.log(10.0)  # that count in the mean of the pads' scale, and its bound
_FORGETTING = 0.97  # of what earlier motions say in the direction of a new one
_RECENT = 0.1  # weight of the last motion in the variance of r


class ForceSensitivity(Recorded, nn.Module):
    """``f_n+ - f_n = (c S + B) w + l |phi| + noise``, S ``= df_n/da``: by recursive least squares::

        u = [S w; 10 |phi|; 20 w],  theta = [c - 1; l / 10; B / 20]        prior N(0, I)
        r = (f_n+ - f_n) - S w - theta u                 of each pad that measures
        D <- D - (1 - .97) D u u' D / (u' D u)           motions, forgotten in the direction of a new one
        theta <- update(theta, (D / s^2 + I)^-1, r, u', s^2),  D <- D + u u'
        s^2 <- .9 s^2 + .1 max(r^2 - u' P u, .15^2)      what is left: a pad that rubs teaches less

    c of each pad scales what the model says: a hand that gives more than it is described to presses less. l
    is what a finger gains or loses as the object turns by phi either way, by friction and creep of cables and
    joints; B ``(n_pads, n_a)`` says the rest. All belong to the hand: they are kept from grasp to grasp.

    Args:
        n_pads, n_a: contact pads and actuators of the hand.

    Source: least squares with directional forgetting, Kulhavy and Karny, IFAC World Congress (1984).
    """

    def __init__(self, n_pads: int, n_a: int) -> None:
        super().__init__()
        self.theta = nn.Buffer(torch.zeros(n_pads, 2 + n_a, dtype=torch.float64))
        self.evidence = nn.Buffer(torch.zeros(n_pads, 2 + n_a, 2 + n_a, dtype=torch.float64))
        """D, of the motions that each pad measured."""
        self.variance = nn.Buffer(torch.full((n_pads,), NOISE.force**2, dtype=torch.float64))
        """s^2 of each pad [N^2]."""
        self.reads = nn.Buffer(torch.zeros(2, dtype=torch.float64))
        """Mean of ln of how many times the pads read what joints and springs give, and of how many grasps."""

    @property
    def usual(self) -> float | None:
        """How many times all pads together read what joints and springs give; None before the first grasp."""
        return math.exp(float(self.reads[0])) if self.reads[1] else None

    def grasped(self, times: float) -> None:
        """All pads together read ``times`` what joints and springs give, in one more grasp of the hand: its
        springs may be others than described, and so may the scale of the pads."""
        before = min(float(self.reads[1]), _GRASPS - 1)
        mean = float(self.reads[0]) + (math.log(times) - float(self.reads[0])) / (before + 1)
        self.reads.copy_(torch.tensor([min(max(mean, -_MOST_READ), _MOST_READ), before + 1]))

    @property
    def scale(self) -> Float[Tensor, " n_pads"]:
        """c."""
        return 1 + self.theta[:, 0]

    @property
    def scale_std(self) -> Float[Tensor, " n_pads"]:
        """Standard error of c."""
        P = _covariance(self.evidence.numpy(), self.variance.numpy())
        return torch.from_numpy(P[:, 0, 0]).sqrt()

    @property
    def correction(self) -> Float[Tensor, "n_pads n_a"]:
        """B [N/rad]."""
        return _PRIOR_STD * self.theta[:, 2:]

    @property
    def by_way(self) -> Float[Tensor, " n_pads"]:
        """l, per turn of the object [N/rad]."""
        return _WAY_STD * self.theta[:, 1]

    def corrected(self, described: Float[Tensor, "n_c n_a"], pads: Sequence[int]) -> Float[Tensor, "n_c n_a"]:
        """``c S + B`` [N/rad].

        Args:
            described: S of the pads in contact [N/rad].
            pads: which of the hand's they are.
        """
        at = list(pads)
        return self.scale[at, None] * described + self.correction[at]

    def spread(
        self, moved: Float[Tensor, " n_a"], said: Float[Tensor, " n_pads"], way: float
    ) -> Float[Tensor, " n_pads"]:
        """``sqrt(u' P u + s^2)``: standard deviation of what is predicted for the change of each force [N].

        P with theta ~ N(0, 0.3^2) before the first motion, as hands were found to be: the wider prior of the
        estimate lets it follow a hand that is none of these.

        Args:
            moved: w [rad].
            said: S w, the change by the model alone [N].
            way: ``|phi|``, turn of the object [rad].
        """
        u = _regressors(said.numpy(), way, moved.numpy())
        variance = self.variance.numpy()
        known = _covariance(
            self.evidence.numpy() + _USUAL * variance[:, None, None] * np.eye(u.shape[-1]), variance
        )
        return torch.from_numpy(np.sqrt(variance + ((known @ u[..., None])[..., 0] * u).sum(-1)))

    @torch.no_grad()
    def update(
        self,
        moved: Float[Tensor, " n_a"],
        change: Float[Tensor, " n_pads"],
        said: Float[Tensor, " n_pads"],
        way: float,
    ) -> Float[Tensor, " n_pads"]:
        """Learn from one motion.

        Args:
            moved: w, of the encoders [rad].
            change: ``f_n+ - f_n`` of each pad [N]; NaN: it does not measure, or does not touch.
            said: S w, the change by the model alone [N].
            way: ``|phi|``, turn of the object [rad].

        Returns:
            r [N], NaN where nothing was measured.

        Raises:
            ShapeError, NonFiniteError: nothing is changed.
        """
        n_pads, n_a = len(self.theta), self.theta.shape[-1] - 2
        for name, value, shape in (
            ("moved", moved, (n_a,)), ("change", change, (n_pads,)), ("said", said, (n_pads,))
        ):  # fmt: skip
            check_shape(name, value, shape)
        check_finite("moved", moved)
        check_finite("said", said)
        check_finite("way", torch.tensor(check_kind("way", way, float)))
        w, df, answer = (x.detach().double().numpy() for x in (moved, change, said))
        buffers = self.theta, self.evidence, self.variance
        theta, D, variance = (buffer.numpy() for buffer in buffers)  # their own memory
        u = _regressors(answer, way, w)
        r = df - answer - (u * theta).sum(-1)
        known = ~np.isnan(r)
        if not known.any() or not w.any():
            return torch.from_numpy(r)
        doubt = ((_covariance(D, variance) @ u[..., None])[..., 0] * u).sum(-1)  # u' P u
        spread = np.sqrt(variance + doubt)
        Du = (D @ u[..., None])[..., 0]
        seen = np.maximum((Du * u).sum(-1), np.finfo(float).tiny)[:, None, None]
        D[known] -= ((1 - _FORGETTING) * Du[:, :, None] * Du[:, None, :] / seen)[known]
        most = NOISE.outlier * spread  # a contact that slips says nothing of the rest
        bounded = np.clip(r, -most, most)
        one = bounded[:, None], u[:, None, :], variance[:, None]
        after, _ = update(theta, _covariance(D, variance), *one, bounds=(-NOISE.furthest, NOISE.furthest))
        theta[known] = after[known]
        D[known] += (u[:, :, None] * u[:, None, :])[known]
        unexplained = np.clip(bounded**2 - doubt, _LEAST_STD**2, _LARGEST_STD**2)
        variance[known] += _RECENT * (unexplained - variance)[known]
        return torch.from_numpy(r)

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        wrong = bound_problems(
            state,
            theta=(-NOISE.furthest, NOISE.furthest),
            variance=(0.9 * _LEAST_STD**2, _LARGEST_STD**2),  # files of a smaller noise hold
            evidence=(-_MOST_EVIDENCE, _MOST_EVIDENCE),
            reads=(-_MOST_READ, _GRASPS),
        )
        if wrong:
            return wrong
        D = state["evidence"]
        if bool((state["theta"].any(-1) & ~D.flatten(1).any(-1)).any()):
            return ["theta is known of a pad without evidence"]
        unit = (1e-9 + 1e-9 * D.abs().amax((-2, -1), keepdim=True)) * torch.eye(D.shape[-1], dtype=D.dtype)
        return covariance_problems("evidence", D + unit)  # it begins at 0, and rounding makes some below

    def extra_repr(self) -> str:
        return f"pads={len(self.theta)}, largest={float(self.correction.abs().max()):.3g} N/rad"


def _regressors(said: Array, way: float, w: Array) -> Array:
    """u of each pad."""
    alike = np.concatenate([[_WAY_STD * way], _PRIOR_STD * w])
    return np.concatenate([said[:, None], np.tile(alike, (len(said), 1))], axis=-1)


def _covariance(D: Array, variance: Array) -> Any:
    """P of each pad."""
    return np.linalg.inv(D / variance[:, None, None] + np.eye(D.shape[-1]))
