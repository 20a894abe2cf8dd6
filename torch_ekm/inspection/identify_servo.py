"""Dead zone and bias of each motor of a real hand, without a model of the hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from ..drivers import HandDriver
from ..exceptions import DeviceError
from ..kinematics import ServoModel
from ..plant import Gate

_SIZES = tuple(math.radians(x) for x in (0.4, 0.8, 1.2, 1.6, 2.0))  # one after the other
_SWING, _REVERSALS = math.radians(5), 6
_MOTIONS = 60  # of a motor at most


def identify_servo(driver: HandDriver, on_motor: Callable[[str], object] = lambda text: None) -> ServoModel:
    """``w = D(v + b; d)`` of the encoders: what was found, for a :class:`~torch_ekm.control.HandKnowledge`.

    Motions of 0.4 to 2 deg, to and fro within 5 deg, one motor after the other, within the driver's limits.
    The empty hand does best.

    Raises:
        DeviceError: a motor does not move, or has no room to.
    """
    servo = ServoModel(driver.hand.actuator_names)
    for i, name in enumerate(servo.names):
        on_motor(name)
        _swing(driver, i, servo)
    return servo


def _swing(driver: HandDriver, i: int, servo: ServoModel) -> None:
    """A motor swings, and the servo learns."""
    gate, seen = Gate(driver, driver.hand), driver.observe()
    channel, name = driver.wiring.motors[i], servo.names[i]
    only = torch.arange(len(servo.names)) == i
    start, largest = float(seen.a[i]), max(_SIZES)
    up, down = channel.upper - start, start - channel.lower
    if max(up, down) < _SWING:
        raise DeviceError(f"motor '{name}'", f"its range leaves it less than {math.degrees(_SWING):.0f} deg")
    first = sign = 1.0 if up > down else -1.0
    reversals = 0
    for k in range(_MOTIONS):
        v = sign * min(_SIZES[k % len(_SIZES)], driver.limits.increment) * only.double()
        before, seen = seen, gate.command(v, by="identify-servo")
        servo.update(v, seen.a - before.a, only)
        way = first * (float(seen.a[i]) - start)
        if way > _SWING - largest if sign == first else way < largest:
            sign, reversals = -sign, reversals + 1
            if reversals > _REVERSALS:
                break
    if reversals == 0:
        problem = f"does not move by commands of {math.degrees(largest):.0f} deg"
        raise DeviceError(f"motor '{name}'", problem)
