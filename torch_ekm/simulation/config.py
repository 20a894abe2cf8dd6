"""How a simulated hand is run: time, gravity, and the grasp it is given."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..exceptions import ParameterError


@dataclass(frozen=True)
class PlantConfig:
    """Settings of a :class:`SimulatedHand`; SI units, the hand frame.

    Raises:
        ParameterError: a figure outside its range.
    """

    gravity: tuple[float, float, float] | None = None
    """In the hand frame [m/s^2]; None: the hand's. It stays fixed during a manipulation, as the paper
    assumes (section II.A), and the plant's ``hand`` carries it to the model."""
    time_step: float = 1e-3
    """[s]; 2 ms is fine for long runs and the most with rigid actuators, 4 ms the most with soft ones."""
    pinch_force: float | None = None
    """Normal force of the thumb in the planned grasp [N]; None: the hand's."""
    thumb: str | None = None
    """Pad that opposes the others; None: the one whose name begins with "thumb", else the one that faces the
    others best while the hand closes."""
    fingers: tuple[str, ...] | None = None
    """Opposing pads; None: index and middle where there are both, else all others."""
    along: tuple[float, float, float] | None = None
    """Direction in the hand of the object's long axis, within 5 deg, about which a pinch can turn it. None:
    the normal of a planar hand, else the axis about which most pads' last joints turn, or that of the hand
    frame within 15 deg of it; y where the fingers stand on a circle."""
    spread: float = 1.0
    """Factor on how far points and tilts of the grasps are drawn from the middle of the object; 0: all are
    centred."""
    relative_to: str = "encoder"
    """Commands are increments of the "encoder" or of the "setpoint"."""

    def __post_init__(self) -> None:
        for name in ("time_step", "pinch_force"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ParameterError(name, value, "finite and greater than 0")
        if not 0 <= self.spread <= 1:
            raise ParameterError("spread", self.spread, "between 0 and 1")
        if self.time_step > 0.004:
            raise ParameterError("time_step", self.time_step, "at most 0.004 s: the tendons need it")
        if self.gravity is not None and (len(self.gravity) != 3 or not all(map(math.isfinite, self.gravity))):
            raise ParameterError("gravity", self.gravity, "three finite numbers [m/s^2]")
        if self.along is not None:
            length = math.sqrt(sum(value * value for value in self.along))
            if len(self.along) != 3 or not math.isfinite(length) or length < 1e-9:
                raise ParameterError("along", self.along, "a direction: three finite numbers, not all zero")
