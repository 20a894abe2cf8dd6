"""The position controller of the motors, with its faults."""

from __future__ import annotations

import numpy as np

from ...exceptions import NonFiniteError, ParameterError, ShapeError
from ...typing import Array
from ..parameters import PlantParameters


class Servo:
    """Motors that follow incremental commands, and stop near where they should::

        u+ = clip(m + da)                       increments relative to the encoders, or
        u+ = clip(u + da)                       accumulated on the set-point (``relative_to``)
        e  = u+ + bias + fresh - m              what is left to do by the controller's measurement
        m+ = m + e - sign(e) min(|e|, dead)     Coulomb dead zone: it stops short by the dead band
        x+ = clip(x, m+ - play, m+ + play)      backlash between the motor and its tendon

    ``m`` is what the encoders read, ``x`` what pulls the tendon.

    Args:
        lower, upper: range of each actuator ``(n_a,)`` [rad].
        parameters: the faults; ``fresh`` is bounded by ``actuator_error``, ``backlash`` is ``2 play``.
        relative_to: "encoder" or "setpoint".
        described_backlash: that of the description, ``(n_a,)``; the parameters' comes on top [rad].
    """

    def __init__(
        self,
        lower: Array,
        upper: Array,
        parameters: PlantParameters,
        relative_to: str = "encoder",
        described_backlash: Array | float = 0.0,
    ) -> None:
        if relative_to not in ("encoder", "setpoint"):
            raise ParameterError("relative_to", relative_to, "'encoder' or 'setpoint'")
        self.lower, self.upper = np.array(lower), np.array(upper)
        self.relative_to, self.described_backlash = relative_to, described_backlash
        self.set_parameters(parameters)
        self.place(np.clip(np.zeros_like(self.lower), self.lower, self.upper))

    def set_parameters(self, parameters: PlantParameters) -> None:
        """Other faults; the motors stay where they are."""
        self._p = parameters
        hardware_instance = np.random.default_rng([parameters.hardware_seed, 0])
        self.bias = parameters.actuator_bias * hardware_instance.uniform(-1.0, 1.0, size=self.lower.shape)
        """Constant error of each controller ``(n_a,)`` [rad]."""

    def place(self, motor: Array) -> None:
        """Stand at ``motor`` with the set-point there and the play in its middle."""
        self.encoder = np.array(motor, dtype=np.float64)
        """Position of the motors ``(n_a,)`` [rad]. Like the others never changed in place."""
        self.output = self.encoder
        """Position after the backlash, where the tendon is fixed ``(n_a,)`` [rad]."""
        self.setpoint = self.encoder

    def plan(self, delta: Array, generator: np.random.Generator) -> Array:
        """Where the motors will stop if commanded to move by ``delta`` [rad].

        Args:
            delta: ``(n_a,)``, or ``(n, n_a)``: set-points one after the other, all relative to where the
                motors are, with one fresh error.

        Raises:
            ShapeError, NonFiniteError: it is not n_a finite numbers; nothing is changed.
        """
        delta = np.asarray(delta, dtype=np.float64)
        if delta.shape[-1:] != self.lower.shape or delta.ndim > 2:
            raise ShapeError("delta_a", f"({len(self.lower)},)", delta.shape)
        if not np.all(np.isfinite(delta)):
            raise NonFiniteError("delta_a", np.flatnonzero(~np.isfinite(delta))[:3].tolist())
        origin = self.encoder if self.relative_to == "encoder" else self.setpoint
        fresh = self._p.actuator_error * generator.uniform(-1.0, 1.0, size=self.lower.shape)
        at, stops = self.encoder, []
        for one in np.atleast_2d(delta):
            self.setpoint = np.clip(origin + one, self.lower, self.upper)
            error = self.setpoint + self.bias + fresh - at
            move = error - np.sign(error) * np.minimum(np.abs(error), self._p.dead_zone)
            at = np.clip(at + move, self.lower, self.upper)
            stops.append(at)
        return np.reshape(stops, delta.shape)

    def move_to(self, motor: Array) -> Array:
        """Turn the motors to ``motor``; returns where the tendons are then fixed (after the play)."""
        self.encoder = np.array(motor, dtype=np.float64)
        play = (self.described_backlash + self._p.backlash) / 2
        self.output = np.minimum(np.maximum(self.output, self.encoder - play), self.encoder + play)
        return self.output
