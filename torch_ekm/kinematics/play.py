"""Play of the drive: the tendon moves only when the motor has taken it up."""

from __future__ import annotations

from typing import NamedTuple

import torch

from .._arrays import like, namespace
from ..description import HandDescription
from ..exceptions import ParameterError, ShapeError
from ..typing import AnyArray, Float, Tensor


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
        self._check(delta_a)
        after = PlayState(self.at(state.low - delta_a).low, self.at(state.high - delta_a).low)
        return delta_a + after.position - state.position, after

    def _check(self, increment: AnyArray) -> None:
        if increment.shape[-1:] != self.width.shape[-1:]:
            expected = f"(*batch, {self.width.shape[-1]})"
            raise ShapeError("delta_a", expected, increment.shape, "one entry per actuator")
