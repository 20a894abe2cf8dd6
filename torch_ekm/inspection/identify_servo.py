"""Dead zone, bias and play of each motor of a real hand, without a model of the hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from ..drivers import HandDriver
from ..exceptions import DeviceError
from ..kinematics import Play, ServoModel
from ..typing import Array

_SIZES = tuple(math.radians(x) for x in (0.4, 0.8, 1.2, 1.6, 2.0))  # one after the other
_SWING, _REVERSALS = math.radians(5), 6
_MOTIONS = 60  # of a motor at most
_WIDEST = math.radians(4)  # play; less than a swing
_EXPLAINED = 0.9  # of the joints' motion, else they do not tell the play


class Width(NamedTuple):
    """Play of a motor's drive, from one end to the other [rad]."""

    value: float
    std: float


@dataclass(frozen=True)
class IdentifiedServos:
    """What was found."""

    servo: ServoModel
    """Dead zones and biases, for a :class:`~torch_ekm.control.HandKnowledge`."""
    play: tuple[Width | None, ...]
    """Of each motor; None: no joint sensor tells."""

    def __str__(self) -> str:
        names = self.servo.names
        lines = [*str(self.servo.extra_repr()).splitlines(), "", "# in the hand's transmission file:"]
        for name, play in zip(names, self.play, strict=True):
            figure = "# no joint sensor tells its play"
            if play is not None:
                value, std = (math.degrees(x) for x in play)
                figure = f"backlash_deg = {value:.2f}  # +-{std:.2f}"
            lines.append(f'[[actuators]]  # name = "{name}"\n{figure}')
        return "\n".join(lines)


def identify_servo(
    driver: HandDriver, *, on_motion: Callable[[str], object] = lambda text: None
) -> IdentifiedServos:
    """``w = D(v + b; d)`` of the encoders, ``q = q_0 + g play(a; width)`` of the joints.

    Motions of 0.4 to 2 deg, to and fro within 5 deg, one motor after the other, within the driver's limits.
    The empty hand does best. Joints are taken as they come: q stands for the sensors' common motion, whatever
    their moment arms.

    Args:
        driver: of the hand.
        on_motion: is told of each motor's end.

    Raises:
        DeviceError: a motor does not move, or has no room to.
    """
    servo = ServoModel(driver.hand.actuator_names)
    plays = []
    for i, name in enumerate(servo.names):
        a, q = _swing(driver, i, servo)
        plays.append(_width(a, q))
        on_motion(f"{name}: {len(a) - 1} motions")
    return IdentifiedServos(servo, tuple(plays))


def _swing(driver: HandDriver, i: int, servo: ServoModel) -> tuple[Array, Array]:
    """Encoder ``(n + 1,)`` and the sensed joints ``(n + 1, n_h)`` of a motor that goes to and fro [rad]; the
    servo learns."""
    channel, name = driver.wiring.motors[i], servo.names[i]
    only = torch.arange(len(servo.names)) == i
    seen = [driver.observe()]
    start = float(seen[0].a[i])
    room = max(channel.upper - start, start - channel.lower)
    if room < _SWING:
        raise DeviceError(f"motor '{name}'", f"its range leaves it less than {math.degrees(_SWING):.0f} deg")
    first = 1.0 if channel.upper - start > start - channel.lower else -1.0
    sign, reversals = first, 0
    for k in range(_MOTIONS):
        v = torch.zeros(len(servo.names), dtype=torch.float64)
        v[i] = sign * min(_SIZES[k % len(_SIZES)], driver.limits.increment)
        seen.append(driver.command(v))
        servo.update(v, seen[-1].a - seen[-2].a, only)
        way = first * (float(seen[-1].a[i]) - start)
        if way > _SWING - max(_SIZES) if sign == first else way < max(_SIZES):
            sign, reversals = -sign, reversals + 1
            if reversals > _REVERSALS:
                break
    if reversals == 0:
        problem = f"does not move by commands of {math.degrees(max(_SIZES)):.0f} deg"
        raise DeviceError(f"motor '{name}'", problem)
    return np.array([float(one.a[i]) for one in seen]), np.array([one.info["joints"] for one in seen])


def _width(a: Array, q: Array) -> Width | None:
    """Of the play between a motor at a and the joints: least squares over a grid of widths."""
    joints = q - q.mean(0)
    if not joints.size:
        return None
    moved = joints @ np.linalg.svd(joints, full_matrices=False)[2][0]  # what they do in common
    widths = torch.arange(0, _WIDEST, math.radians(0.02), dtype=torch.float64)
    play = Play(widths)
    state, pulled = play.at(torch.zeros_like(widths)), [torch.zeros_like(widths)]
    for step in torch.from_numpy(np.diff(a)):
        dx, state = play.advance(state, step.expand(len(widths)))
        pulled.append(pulled[-1] + dx)
    x = torch.stack(pulled).numpy()
    reversed_at = int(np.argmax(np.abs(a - a[0]) > _SWING - max(_SIZES) - 1e-9))
    x, y = x[reversed_at:], moved[reversed_at:]  # the play before the first swing is unknown
    x, y = x - x.mean(0), y - y.mean()
    squares = float(y @ y) - np.square(y @ x) / np.square(x).sum(0)
    least = int(np.argmin(squares))
    if squares[least] > (1 - _EXPLAINED) * float(y @ y):
        return None
    as_good = widths[torch.from_numpy(squares <= squares[least] * (1 + 1 / max(1, len(y) - 3)))]
    spread = max(float(as_good.max() - as_good.min()) / 2, math.radians(0.01))
    return Width(float(widths[least]), spread)
