"""Dead zone, bias and play of each servo, identified on its encoder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from .._arrays import like, namespace
from .._checks import check_finite, check_last, check_shape
from .._noise import NOISE
from .._recorded import Recorded, bound_problems, covariance_problems
from ..description import HandDescription
from ..exceptions import ParameterError
from ..typing import AnyArray, Array, Bool, Float, Tensor


class PlayState(NamedTuple):
    """Bounds of ``z = x - m``, where the output x stands within the play of the motor at m [rad]."""

    low: Float[AnyArray, "*batch n_a"]
    high: Float[AnyArray, "*batch n_a"]

    @property
    def position(self) -> Float[AnyArray, "*batch n_a"]:
        """z, the middle of the bounds [rad]."""
        return 0.5 * (self.low + self.high)


class Play:
    """``z+ = clip(z - da, -w/2, w/2)``,  transmitted ``dx = da + z+ - z``.

    The play operator of each actuator by itself (Krasnosel'skii and Pokrovskii, Systems with Hysteresis,
    1989): a reversal of the motor moves nothing until it has gone through the width w. ``da`` is one
    straight motion of the motor. An unknown start is the interval of all of the play; z+ is monotone in z,
    so the ends are carried along exactly, and every increment narrows it. Differentiable, also by ``width``.

    Args:
        width: w of each actuator, from one end of the play to the other [rad].

    Raises:
        ParameterError: a width is negative or not finite.
    """

    def __init__(self, width: Float[Tensor, " n_a"]) -> None:
        if not bool((torch.isfinite(width) & (width >= 0)).all()):
            raise ParameterError("width", width.tolist(), "finite and not negative [rad]")
        self.width = width

    @classmethod
    def of(cls, hand: HandDescription, dtype: torch.dtype = torch.float64) -> Play:
        """That of the hand's actuators (``backlash`` in its transmission file)."""
        return cls(torch.as_tensor(hand.actuator_backlash).to(dtype))

    def unknown(self) -> PlayState:
        """The state after an unknown history: anywhere within the play [rad]."""
        return PlayState(-0.5 * self.width, 0.5 * self.width)

    def at(self, position: Float[AnyArray, "*batch n_a"]) -> PlayState:
        """A known position z, brought into the play: 0 is its middle [rad]."""
        xp, half = namespace(position), 0.5 * like(self.width, position)
        z = xp.minimum(xp.maximum(position, -half), half)
        return PlayState(z, z)

    def advance(
        self, state: PlayState, delta_a: Float[AnyArray, "*batch n_a"]
    ) -> tuple[Float[AnyArray, "*batch n_a"], PlayState]:
        """What the tendons move by when the motors move by ``delta_a``, and the play afterwards [rad].

        Of an unknown start: the middle of what is possible.

        Raises:
            ShapeError: ``delta_a`` has not one entry per actuator.
        """
        check_last("delta_a", delta_a, len(self.width), "one entry per actuator")
        after = PlayState(self.at(state.low - delta_a).low, self.at(state.high - delta_a).low)
        return delta_a + after.position - state.position, after


Mask = NDArray[np.bool_]
_DEG = math.pi / 180
_PRIOR_STD = (NOISE.dead_zone, NOISE.bias)
_LEAST_STD = 1e-6  # [rad] of that error: no encoder is better
_FORGETTING = 0.995  # of the least squares, for each motion
_WEIGHTS = 10.0, 1 / (1 - _FORGETTING)  # of the noise's estimate, in motions: first and at last


class IdealServos(Recorded, nn.Module):
    """``w = v``: servos that go where they are commanded, of which nothing is learned.

    Args:
        names: of the actuators.
    """

    learns = False
    moved_from = resolution = largest = 0.0

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        self.stuck = nn.Buffer(torch.zeros(len(self.names)).bool())

    @property
    def bias(self) -> Float[Tensor, " n_a"]:
        """0 [rad]."""
        return torch.zeros(len(self.names), dtype=torch.float64)

    def command(self, wanted: Float[Tensor, " n_a"]) -> Float[Tensor, " n_a"]:
        """v = w: the increments that are wanted, unchanged [rad]."""
        return wanted

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        return ["stuck: ideal servos are not"] if bool(state["stuck"].any()) else []

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
    resolution = NOISE.still
    """Wanted motions up to this size are none [rad]."""
    largest = 6 * _DEG
    """No dead zone, bias or error of a motion is larger [rad]."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        self._prior = torch.diag(torch.tensor(_PRIOR_STD, dtype=torch.float64).square()) / NOISE.servo**2
        n = len(self.names)
        self.estimate = nn.Buffer(torch.zeros(n, 2).double())  # theta = (d, b) [rad]
        self.covariance = nn.Buffer(self._prior.repeat(n, 1, 1))  # of theta, in units of the noise's variance
        self.weight = nn.Buffer(torch.full((n,), _WEIGHTS[0]).double())
        self.squares = nn.Buffer(self.weight * NOISE.servo**2)
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
        bias = self.estimate[:, 1] - self.covariance[:, 1, 0] / self.covariance[:, 0, 0] * negative
        return bias.clamp(-self.largest, self.largest)

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
        v, w = command.detach().double().numpy(), moved.detach().double().numpy()
        # the buffers' own memory: small torch operations cost ten times as much
        at = SimpleNamespace(**{name: buffer.numpy() for name, buffer in self.named_buffers()})
        np.clip(at.estimate, -self.largest, self.largest, out=at.estimate)  # as it is used
        went = (abs(w) > self.moved_from) & (True if free is None else free.numpy())
        stood = ~went & (abs(v) > self.resolution) & ~at.stuck & (True if free is None else free.numpy())
        at.failures[went], at.stuck[went] = 0, False
        first = stood & (at.failures == 0)
        at.before[first] = at.estimate[first]
        at.before_covariance[first] = at.covariance[first]
        at.failures[stood] += 1
        if went.any():
            self._regress(at, v, w, went)
        if stood.any():
            self._censored(at, v, stood)
        lost = stood & (at.estimate[:, 0] > self.largest)
        at.stuck[lost] = True
        at.estimate[lost], at.covariance[lost] = at.before[lost], at.before_covariance[lost]
        np.clip(at.estimate, -self.largest, self.largest, out=at.estimate)

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        angle, variance = (-self.largest, self.largest), state["squares"] / state["weight"]
        wrong = bound_problems(state, estimate=angle, before=angle, weight=_WEIGHTS, surprises=(0, 1))
        if not bool(((variance >= 0.99 * _LEAST_STD**2) & (variance <= self.largest**2)).all()):
            wrong.append("squares: a servo's error is none, or larger than its largest dead zone")
        if bool((state["stuck"] & (state["failures"] == 0)).any()):
            wrong.append("stuck: a servo that never failed to move")
        for name in ("covariance", "before_covariance"):
            wrong += covariance_problems(name, state[name], self._prior.diagonal())
        return wrong

    def _regress(self, at: SimpleNamespace, v: Array, w: Array, went: Mask) -> None:
        """``v - w = x.theta + noise``, ``x = [sign(w), -1]``, of the servos that moved."""
        x = np.stack([np.sign(w[went]), np.full(went.sum(), -1.0)], axis=-1)
        noise = at.squares[went] / at.weight[went]
        error = v[went] - w[went] - (x * at.estimate[went]).sum(-1)
        Px, spread = _spread(at, x, went)
        self._open(at, error**2 > NOISE.outlier**2 * noise * spread, went)
        error = v[went] - w[went] - (x * at.estimate[went]).sum(-1)
        Px, spread = _spread(at, x, went)
        at.estimate[went] += Px * (error / spread)[:, None]
        P = at.covariance[went] - Px[..., None] * Px[:, None, :] / spread[:, None, None]
        faded = P / _FORGETTING  # never less sure than at the start: no blow-up without excitation
        small = (faded[:, [0, 1], [0, 1]] <= self._prior.diagonal().numpy()).all(-1)
        at.covariance[went] = np.where(small[:, None, None], faded, P)
        # bounded: a servo that has become another one is not a noisy one
        most = np.minimum(NOISE.outlier**2 * noise, self.largest**2)
        square = np.clip(error**2 / spread, _LEAST_STD**2, most)
        at.weight[went] = _FORGETTING * at.weight[went] + 1
        at.squares[went] = _FORGETTING * at.squares[went] + square

    def _censored(self, at: SimpleNamespace, v: Array, stood: Mask) -> None:
        """``x.theta + noise > |v|``, ``x = [1, -sign(v)]``, of the servos that stood: moments of the
        truncated normal."""
        x = np.stack([np.ones(stood.sum()), -np.sign(v[stood])], axis=-1)
        noise = at.squares[stood] / at.weight[stood]

        def excess(spread: Array) -> Array:
            return ((x * at.estimate[stood]).sum(-1) - abs(v[stood])) / np.sqrt(noise * spread)

        Px, spread = _spread(at, x, stood)
        self._open(at, excess(spread) < -NOISE.outlier, stood)
        Px, spread = _spread(at, x, stood)
        z = excess(spread)
        beyond = torch.special.log_ndtr(torch.from_numpy(z)).numpy()
        hazard = np.exp(-0.5 * z**2 - beyond) / math.sqrt(2 * math.pi)
        at.estimate[stood] += Px * (hazard * np.sqrt(noise / spread))[:, None]
        shrink = np.clip(hazard * (hazard + z), 0, 1) / spread
        at.covariance[stood] -= Px[..., None] * Px[:, None, :] * shrink[:, None, None]

    def _open(self, at: SimpleNamespace, surprising: Mask, which: Mask) -> None:
        """The second surprise in succession: it is another servo, its old estimate is no evidence."""
        again = surprising & (at.surprises[which] > 0)
        at.estimate[which] = np.where(again[:, None], 0.0, at.estimate[which])
        at.covariance[which] = np.where(again[:, None, None], self._prior.numpy(), at.covariance[which])
        at.surprises[which] = surprising & ~again

    def extra_repr(self) -> str:
        d, b = (torch.stack([self.dead_zone, self.bias]) / _DEG).tolist()
        sd, sb = (self.standard_errors / _DEG).tolist()
        return "\n".join(
            f"{name}: d={d[i]:.2f}±{sd[i]:.2f} b={b[i]:.2f}±{sb[i]:.2f} deg{' (stuck)' * bool(self.stuck[i])}"
            for i, name in enumerate(self.names)
        )


def _spread(at: SimpleNamespace, x: Array, which: Mask) -> tuple[Array, Array]:
    """``P x`` and ``1 + x^T P x``: covariances in units of the noise's variance."""
    Px = (at.covariance[which] @ x[..., None])[..., 0]
    return Px, 1 + (x * Px).sum(-1)
