"""Dead zone and bias of each servo, identified on its encoder."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import nn

from .._checks import check_finite, check_shape
from .._recorded import Recorded
from ..typing import Bool, Float, Tensor

_DEG = math.pi / 180
_PRIOR_STD = (1.0 * _DEG, 0.3 * _DEG)  # [rad] of d and b before the first motion
_NOISE_STD = 0.1 * _DEG  # [rad] of a servo's error from motion to motion, a first guess worth ten motions
_FORGETTING = 0.995  # of the least squares, for each motion


class IdealServos(Recorded, nn.Module):
    """``w = v``: servos that go where they are commanded, of which nothing is learned.

    Args:
        names: of the actuators.
    """

    learns = False
    moved_from = 0.0

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        self.stuck = nn.Buffer(torch.zeros(len(self.names)).bool())

    def command(self, wanted: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """v = w: the increments that are wanted, unchanged [rad]."""
        return wanted

    def update(self, command: Tensor, moved: Tensor, free: Tensor | None = None) -> None:
        """Does nothing: ideal servos have neither dead zone nor bias to be learned."""


class ServoModel(Recorded, nn.Module):
    """``w = D(v + b; d)``, ``D(x; d) = x - clip(x, -d, d)``: v commanded, w moved, for each servo.

    ```
    moved:      v - w = sign(w) d - b + noise     linear in (d, b): recursive least squares, forgetting
    stood:      |v + b| <= d + noise              a motion that fails is a measurement, too: a censored one
    command:    v = w + sign(w) d - b             the inverse, for wanted motions above ``resolution``
    ```

    The least squares is Bayesian (normal, inverse gamma), so d and b come with standard errors, which the
    spread of the servo's own motions sets. Two motions in succession that the errors do not explain open the
    estimate again, as after a repair. A servo whose dead zone would exceed ``largest`` is called
    :attr:`stuck`; it keeps the estimate from before its first failure and is commanded as before, so nothing
    is wound up when it comes loose. All is in the state dict.

    Args:
        names: of the actuators.

    Source: the factorisation of a Hammerstein system; adaptive inverses: Tao and Kokotovic, Adaptive Control
    of Systems with Actuator and Sensor Nonlinearities (1996).
    """

    learns = True
    moved_from = 3 * (0.01 * _DEG)
    """Readings of an encoder up to this size are its noise, three standard deviations [rad]."""
    resolution = 0.02 * _DEG
    """Wanted motions up to this size are none [rad]."""
    largest = 6 * _DEG
    """No dead zone is larger [rad]."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        self._prior = torch.diag(torch.tensor(_PRIOR_STD, dtype=torch.float64).square()) / _NOISE_STD**2
        n = len(self.names)
        self.estimate = nn.Buffer(torch.zeros(n, 2).double())  # theta = (d, b) [rad]
        self.covariance = nn.Buffer(self._prior.repeat(n, 1, 1))  # of theta, in units of the noise's variance
        self.weight = nn.Buffer(torch.full((n,), 10.0).double())
        self.squares = nn.Buffer(self.weight * _NOISE_STD**2)
        self.before = nn.Buffer(self.estimate.clone())  # theta before the first failure in succession
        self.before_covariance = nn.Buffer(self.covariance.clone())
        self.failures = nn.Buffer(torch.zeros(n).long())  # commands in succession that moved nothing
        self.surprises = nn.Buffer(torch.zeros(n).long())
        self.stuck = nn.Buffer(torch.zeros(n).bool())

    @property
    def dead_zone(self) -> Float[Tensor, " n_a"]:
        """d, the half width of each servo's dead zone, at least 0 [rad]."""
        return self.estimate[:, 0].clamp(min=0.0)

    @property
    def bias(self) -> Float[Tensor, " n_a"]:
        """b [rad]: the most probable one with ``d >= 0``."""
        negative = self.estimate[:, 0].clamp(max=0.0)  # what d gives up, b takes over as they are correlated
        return self.estimate[:, 1] - self.covariance[:, 1, 0] / self.covariance[:, 0, 0] * negative

    @property
    def noise_std(self) -> Float[Tensor, " n_a"]:
        """Spread of the servo's own error from motion to motion [rad]."""
        return (self.squares / self.weight).sqrt()

    @property
    def standard_errors(self) -> Float[Tensor, "2 n_a"]:
        """Standard errors of the estimates d (first row) and b (second row) [rad]."""
        return self.noise_std * self.covariance.diagonal(dim1=-2, dim2=-1).T.sqrt()

    def command(self, wanted: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """v that moves the servos by w [rad]."""
        inverse = wanted + wanted.sign() * self.dead_zone - self.bias
        return torch.where(wanted.abs() > self.resolution, inverse, torch.zeros_like(wanted))

    @torch.no_grad()
    def update(
        self,
        command: Float[Tensor, " n_a"],
        moved: Float[Tensor, " n_a"],
        free: Bool[Tensor, " n_a"] | None = None,
    ) -> None:
        """Learn from one motion.

        Args:
            command: v [rad].
            moved: w, the encoders' change [rad].
            free: servos that no end stop kept from moving; None: all.

        Raises:
            ShapeError, NonFiniteError: nothing is changed.
        """
        for name, value in (("command", command), ("moved", moved)):
            check_shape(name, value, self.stuck.shape)
            check_finite(name, value)
        free = torch.ones_like(self.stuck) if free is None else free
        v, w = command.double(), moved.double()
        went = free & (w.abs() > self.moved_from)
        stood = free & ~went & (v.abs() > self.resolution) & ~self.stuck
        self.failures[went], self.stuck[went] = 0, False
        first = stood & (self.failures == 0)
        self.before[first] = self.estimate[first]
        self.before_covariance[first] = self.covariance[first]
        self.failures[stood] += 1
        self._regress(v, w, went)
        self._censored(v, stood)
        lost = stood & (self.dead_zone > self.largest)
        self.stuck |= lost
        self.estimate[lost], self.covariance[lost] = self.before[lost], self.before_covariance[lost]

    def _regress(self, v: Tensor, w: Tensor, went: Tensor) -> None:
        """``v - w = x.theta + noise``, ``x = [sign(w), -1]``, of the servos that moved."""
        if not bool(went.any()):
            return
        x = torch.stack([w[went].sign(), -torch.ones_like(w[went])], dim=-1)
        noise = self.noise_std[went].square()
        error = v[went] - w[went] - (x * self.estimate[went]).sum(-1)
        Px, spread = self._spread(x, went)
        surprising = error.square() > 16 * noise * spread
        self._open(surprising, went)
        Px, spread = self._spread(x, went)
        self.estimate[went] += Px * (error / spread)[:, None]
        P = self.covariance[went] - Px[..., None] * Px[:, None, :] / spread[:, None, None]
        faded = P / _FORGETTING  # never less sure than at the start: no blow-up without excitation
        small = (faded.diagonal(dim1=-2, dim2=-1) <= self._prior.diagonal()).all(-1)
        self.covariance[went] = torch.where(small[:, None, None], faded, P)
        # bounded: a servo that has become another one is not a noisy one
        square = (error.square() / spread).clamp(max=16 * noise)
        self.weight[went] = _FORGETTING * self.weight[went] + 1
        self.squares[went] = _FORGETTING * self.squares[went] + square

    def _censored(self, v: Tensor, stood: Tensor) -> None:
        """``x.theta + noise > |v|``, ``x = [1, -sign(v)]``, of the servos that stood: moments of the
        truncated normal."""
        if not bool(stood.any()):
            return
        x = torch.stack([torch.ones_like(v[stood]), -v[stood].sign()], dim=-1)
        noise = self.noise_std[stood].square()

        def excess(spread: Tensor) -> Tensor:
            return ((x * self.estimate[stood]).sum(-1) - v[stood].abs()) / (noise * spread).sqrt()

        Px, spread = self._spread(x, stood)
        self._open(excess(spread) < -4, stood)
        Px, spread = self._spread(x, stood)
        z = excess(spread)
        hazard = torch.exp(-0.5 * z.square() - torch.special.log_ndtr(z)) / math.sqrt(2 * math.pi)
        self.estimate[stood] += Px * (hazard * (noise / spread).sqrt())[:, None]
        shrink = (hazard * (hazard + z)).clamp(0, 1) / spread
        self.covariance[stood] -= Px[..., None] * Px[:, None, :] * shrink[:, None, None]

    def _spread(self, x: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """``P x`` and ``1 + x^T P x``: covariances in units of the noise's variance."""
        Px = (self.covariance[which] @ x[..., None])[..., 0]
        return Px, 1 + (x * Px).sum(-1)

    def _open(self, surprising: Tensor, which: Tensor) -> None:
        """The second surprise in succession: it is another servo, its old estimate is no evidence."""
        again = surprising & (self.surprises[which] > 0)
        self.covariance[which] = torch.where(again[:, None, None], self._prior, self.covariance[which])
        self.surprises[which] = (surprising & ~again).long()

    def extra_repr(self) -> str:
        d, b = (torch.stack([self.dead_zone, self.bias]) / _DEG).tolist()
        sd, sb = (self.standard_errors / _DEG).tolist()
        return "\n".join(
            f"{name}: d={d[i]:.2f}±{sd[i]:.2f} b={b[i]:.2f}±{sb[i]:.2f} deg{' (stuck)' * bool(self.stuck[i])}"
            for i, name in enumerate(self.names)
        )
