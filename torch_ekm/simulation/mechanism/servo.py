"""The position controller of the motors, with its faults."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...exceptions import NonFiniteError, ParameterError, ShapeError
from ...typing import Array


class ServoState(NamedTuple):
    """All that a :class:`Servo` remembers between commands."""

    setpoint: Array
    motor: Array
    output: Array


class Servo:
    """Motors that follow incremental commands, and stop near where they should::

        u+ = clip(m + da)                       increments relative to the encoders, or
        u+ = clip(u + da)                       accumulated on the set-point (``relative_to``)
        e  = u+ + bias + fresh - m              what the controller believes is left to do
        m+ = m + e - sign(e) min(|e|, dead)     Coulomb dead zone: it stops short by the dead band
        x+ = clip(x, m+ - play, m+ + play)      backlash between the motor and its tendon

    ``m`` is what the encoders read, ``x`` what pulls the tendon. A second kind of dead band, the
    threshold, ignores a command smaller than it altogether.

    Args:
        lower, upper: range of each actuator ``(n_a,)`` [rad].
        bias: constant error of each controller ``(n_a,)`` [rad].
        fresh_error: bound of an error drawn anew at every command, uniform [rad].
        dead_zone: Coulomb dead band [rad].
        threshold: commands smaller than this do nothing [rad].
        backlash: full width of the play, ``2 play``; one for all, or one per actuator [rad].
        relative_to: "encoder" or "setpoint".
    """

    def __init__(
        self,
        lower: Array,
        upper: Array,
        bias: Array,
        fresh_error: float = 0.0,
        dead_zone: float = 0.0,
        threshold: float = 0.0,
        backlash: float | Array = 0.0,
        relative_to: str = "encoder",
    ) -> None:
        if relative_to not in ("encoder", "setpoint"):
            raise ParameterError("relative_to", relative_to, "'encoder' or 'setpoint'")
        self.lower, self.upper = np.array(lower), np.array(upper)
        self.bias = np.broadcast_to(np.asarray(bias, dtype=np.float64), self.lower.shape).copy()
        self.fresh_error, self.dead_zone = fresh_error, dead_zone
        self.threshold, self.backlash = threshold, backlash
        self.relative_to = relative_to
        self.place(np.clip(np.zeros_like(self.lower), self.lower, self.upper))

    @property
    def encoder(self) -> Array:
        """Position of the motors ``(n_a,)`` [rad]."""
        return self._motor.copy()

    @property
    def output(self) -> Array:
        """Position after the backlash, where the tendon is fixed ``(n_a,)`` [rad]."""
        return self._output.copy()

    def place(self, motor: Array) -> None:
        """Stand at ``motor`` with the set-point there and the play in its middle."""
        self._motor = np.array(motor, dtype=np.float64)
        self._setpoint = self._motor.copy()
        self._output = self._motor.copy()

    def plan(self, delta: Array, generator: np.random.Generator) -> Array:
        """Where the motors will stop if told to move by ``delta`` ``(n_a,)`` [rad].

        Raises:
            ShapeError, NonFiniteError: ``delta`` is not ``n_a`` finite numbers; nothing is changed.
        """
        delta = np.asarray(delta, dtype=np.float64)
        if delta.shape != self.lower.shape:
            raise ShapeError("delta_a", f"({len(self.lower)},)", delta.shape)
        if not np.all(np.isfinite(delta)):
            raise NonFiniteError("delta_a", np.flatnonzero(~np.isfinite(delta))[:3].tolist())
        origin = self._motor if self.relative_to == "encoder" else self._setpoint
        fresh = self.fresh_error * generator.uniform(-1.0, 1.0, size=delta.shape)
        setpoint = np.clip(origin + delta, self.lower, self.upper)
        error = setpoint + self.bias + fresh - self._motor
        move = error - np.sign(error) * np.minimum(np.abs(error), self.dead_zone)
        move = np.where(np.abs(setpoint - self._motor) < self.threshold, 0.0, move)
        self._setpoint = setpoint
        return np.clip(self._motor + move, self.lower, self.upper)

    def move_to(self, motor: Array) -> Array:
        """Turn the motors to ``motor``; returns where the tendons are then fixed (after the play)."""
        self._motor = np.array(motor, dtype=np.float64)
        play = self.backlash / 2
        self._output = np.clip(self._output, self._motor - play, self._motor + play)
        return self._output

    def snapshot(self) -> ServoState:
        return ServoState(self._setpoint.copy(), self._motor.copy(), self._output.copy())

    def restore(self, state: ServoState) -> None:
        self._setpoint, self._motor, self._output = (part.copy() for part in state)
