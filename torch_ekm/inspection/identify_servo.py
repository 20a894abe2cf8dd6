"""Dead zone, bias and play of each motor of a real hand, without a model of the hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from ..drivers import HandDriver
from ..exceptions import DeviceError
from ..kinematics import Play, ServoModel
from ..plant import Gate
from ..typing import Array

_SIZES = tuple(math.radians(x) for x in (0.4, 0.8, 1.2, 1.6, 2.0))  # one after the other
_SWING, _REVERSALS = math.radians(5), 6
_MOTIONS = 60  # of a motor at most
_WIDEST = math.radians(4)  # play; less than a swing
_LEFT = 0.1  # share of the joints' motion that play may leave unexplained, else they do not determine it


class IdentifiedServos(NamedTuple):
    """What was found."""

    servo: ServoModel
    """Dead zones and biases, for a :class:`~torch_ekm.control.HandKnowledge`."""
    play: tuple[tuple[float, float] | None, ...]
    """Width of the play of each drive, and its standard deviation [rad]; None: no sensor measures it."""

    def __str__(self) -> str:
        lines = [self.servo.extra_repr(), "", "# in the hand's transmission file:"]
        for name, play in zip(self.servo.names, self.play, strict=True):
            figures = "backlash_deg = {:.2f}  # +-{:.2f}".format(*map(math.degrees, play or (0, 0)))
            lines.append(f'[[actuators]]  # name = "{name}"')
            lines.append(figures if play else "# no joint sensor measures its play")
        return "\n".join(lines)


def identify_servo(
    driver: HandDriver, on_motor: Callable[[str], object] = lambda text: None
) -> IdentifiedServos:
    """``w = D(v + b; d)`` of the encoders, ``q = q_0 + g play(a; width)`` of the joints.

    Motions of 0.4 to 2 deg, to and fro within 5 deg, one motor after the other, within the driver's limits.
    The empty hand does best. Joints are taken as they come: q stands for the sensors' common motion, whatever
    their moment arms.

    Raises:
        DeviceError: a motor does not move, or has no room to.
    """
    servo, play = ServoModel(driver.hand.actuator_names), []
    for i, name in enumerate(servo.names):
        on_motor(name)
        play.append(_width(*_swing(driver, i, servo)))
    return IdentifiedServos(servo, tuple(play))


def nearest_column(grid: Array, X: Array, y: Array) -> tuple[float, float, float]:
    """``min_k |y - c - g X[:, k]|^2``: the grid's value there, its standard deviation, share of y left."""
    X, y = X - X.mean(0), y - y.mean()
    squares = y @ y - np.square(y @ X) / np.maximum(np.square(X).sum(0), 1e-300)
    least = squares.min()
    as_good = grid[squares <= least * (1 + 1 / max(1, len(y) - 3))]
    return float(grid[squares.argmin()]), float(np.ptp(as_good) / 2), float(least / max(y @ y, 1e-300))


def _swing(driver: HandDriver, i: int, servo: ServoModel) -> tuple[Array, Array]:
    """Encoder ``(n + 1,)``, sensed joints ``(n + 1, n_h)`` of a motor that swings [rad]; the servo learns."""
    gate = Gate(driver, driver.hand)
    channel, name, seen = driver.wiring.motors[i], servo.names[i], [driver.observe()]
    only = torch.arange(len(servo.names)) == i
    start, largest = float(seen[0].a[i]), max(_SIZES)
    up, down = channel.upper - start, start - channel.lower
    if max(up, down) < _SWING:
        raise DeviceError(f"motor '{name}'", f"its range leaves it less than {math.degrees(_SWING):.0f} deg")
    first = sign = 1.0 if up > down else -1.0
    reversals = 0
    for k in range(_MOTIONS):
        v = sign * min(_SIZES[k % len(_SIZES)], driver.limits.increment) * only.double()
        seen.append(gate.command(v, by="identify-servo"))
        servo.update(v, seen[-1].a - seen[-2].a, only)
        way = first * (float(seen[-1].a[i]) - start)
        if way > _SWING - largest if sign == first else way < largest:
            sign, reversals = -sign, reversals + 1
            if reversals > _REVERSALS:
                break
    if reversals == 0:
        problem = f"does not move by commands of {math.degrees(largest):.0f} deg"
        raise DeviceError(f"motor '{name}'", problem)
    return np.array([float(one.a[i]) for one in seen]), np.array([one.info["joints"] for one in seen])


def _width(a: Array, q: Array) -> tuple[float, float] | None:
    """Of the play between a motor at a and joints, and its standard deviation [rad]."""
    joints = q - q.mean(0)
    if not joints.size:
        return None
    common = joints @ np.linalg.svd(joints, full_matrices=False)[2][0]
    widths = torch.arange(0, _WIDEST, math.radians(0.02), dtype=torch.float64)
    play, pulled = Play(widths), [torch.zeros_like(widths)]
    state = play.at(pulled[0])
    for step in torch.from_numpy(np.diff(a)):
        dx, state = play.advance(state, step.expand(len(widths)))
        pulled.append(pulled[-1] + dx)
    taken_up = int(np.argmax(np.abs(a - a[0]) > _SWING - max(_SIZES) - 1e-9))  # before it, play is unknown
    x = torch.stack(pulled).numpy()[taken_up:]
    width, std, left = nearest_column(widths.numpy(), x, common[taken_up:])
    return (width, max(std, math.radians(0.01))) if left < _LEFT else None
