"""Where each tendon of a real hand is just taut."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from .._files import write_whole
from ..description._reading import toml_text
from ..drivers import HandDriver, Wiring
from ..exceptions import DescriptionError, DeviceError
from ..plant import Gate
from ..typing import Array

_STEP = math.radians(1)
_LOOKS = 5  # readings of the load after each step
_FLAT, _RISING = 5, 8  # steps: of the slack tendon at least; above these until it is called taut
_RISES, _LEAST = 6.0, 2.0  # a load rises by more than so many standard deviations, and units of the bus


class Taut(NamedTuple):
    """A motor whose tendon was found, and its ``zero`` for the wiring file [bus units]."""

    motor: str
    zero: float
    std: float


def find_slack(driver: HandDriver, on_step: Callable[[str], object] = lambda text: None) -> list[Taut]:
    """``load(a) = c + k max(0, a - a_taut)``: each motor closes by 1 deg at a time until its load rises.

    The tendon is then taut with the finger at its rest, where the description has ``a = a_0 + J_a q_0``: this
    gives the motor's ``zero``. Begin with slack tendons and an empty hand. No motor goes farther from where
    it stands than its range is long; each goes back. Motors that shape the hand are left out.

    Raises:
        DeviceError: the bus reports no load; a tendon is taut from the start or never; a motor does not move.
    """
    hand, given = driver.hand, driver.wiring
    at_rest = np.clip(hand.spring_rest, hand.joint_lower, hand.joint_upper)
    taut = hand.unloaded(at_rest)
    found = []
    try:
        here = [  # positions count from where each motor stands
            replace(one, zero=one.zero + one.bus(float(a)) - one.bus(one.lower))
            for one, a in zip(given.motors, driver.observe().a, strict=True)
        ]
        driver.wiring = replace(given, motors=tuple(here))
        for i, one in enumerate(here):
            if not hand.actuators[i].posture:
                a, std = _close(driver, i, on_step)
                found.append(Taut(one.name, one.bus(a - float(taut[i])), std * one.per_unit))
    finally:
        driver.wiring = given
    return found


def write_zeros(wiring: Wiring, found: list[Taut]) -> None:
    """Write them into the wiring file, whose other lines and comments stay as they are.

    Raises:
        DescriptionError: a motor's table is not found in it.
        OutputError: it cannot be written.
    """
    lines = toml_text(wiring.path, "wiring file").split("\n")  # only these end a line of TOML
    for number, one in sorted(
        ((wiring.line("motors", one.motor, "zero"), one) for one in found), reverse=True
    ):
        if not number:
            raise DescriptionError(wiring.path, f"no [[motors]] table of '{one.motor}': write its zero there")
        text, old = f"zero = {one.zero:.6g}", re.compile(r"""^(\s*)["']?zero["']?\s*=\s*[^#\s]+""")
        line = lines[number - 1]
        lines[number - 1 : number] = [old.sub(rf"\1{text}", line)] if old.match(line) else [line, text]
    write_whole(wiring.path, "\n".join(lines))


def _close(driver: HandDriver, i: int, on_step: Callable[[str], object]) -> tuple[float, float]:
    """Where the tendon of motor i is taut, and its standard deviation [rad]."""
    gate = Gate(driver, driver.hand)
    motor, limit = driver.wiring.motors[i], driver.limits.increment
    way, problem = [_position_and_load(driver, i)], ""
    delta = torch.zeros(driver.hand.n_a, dtype=torch.float64)
    delta[i] = min(_STEP, limit)
    while not problem and not _rises(way, _RISING):
        if way[-1][0] > motor.upper - float(delta[i]):
            problem = "closed by all of its range, and its load never rose"
            break
        gate.command(delta, by="slack")
        way.append(_position_and_load(driver, i))
        on_step(f"{motor.name}: {math.degrees(way[-1][0] - way[0][0]):.1f} deg, load {way[-1][1]:.3g}")
        if way[-1][0] - way[-2][0] < _STEP / 4:  # a dead zone, or all that its current can pull
            if _rises(way, 3):
                break
            if delta[i] >= min(4 * _STEP, limit):
                problem = "does not move, and its load does not rise"
            delta[i] = min(2 * float(delta[i]), limit)
    closed = way[-1][0] - way[0][0]
    for _ in range(pieces := math.ceil(closed / limit)):
        delta[i] = -closed / pieces
        gate.command(delta, by="slack")
    a, load = np.array(way).T
    knots = np.linspace(a[0], a[-1], 40 * len(a), endpoint=False)
    at, std = _nearest_column(knots, np.maximum(0, a[:, None] - knots), load)
    if not problem and at < a[2]:
        problem = "its load rises from the start: let the tendon out until it is slack, then once more"
    if problem:
        raise DeviceError(f"motor '{motor.name}'", problem)
    return at, std


def _nearest_column(grid: Array, X: Array, y: Array) -> tuple[float, float]:
    """``min_k |y - c - g X[:, k]|^2``: the grid's value there, and its standard deviation."""
    X, y = X - X.mean(0), y - y.mean()
    squares = y @ y - np.square(y @ X) / np.maximum(np.square(X).sum(0), 1e-300)
    as_good = grid[squares <= squares.min() * (1 + 1 / max(1, len(y) - 3))]
    return float(grid[squares.argmin()]), float(np.ptp(as_good) / 2)


def _position_and_load(driver: HandDriver, i: int) -> tuple[float, float]:
    seen = [driver.observe() for _ in range(_LOOKS)]
    if not seen[-1].info["load"]:
        raise DeviceError(driver.wiring.path.name, "the bus reports no motor loads: set the zeros by hand")
    return float(seen[-1].a[i]), float(np.mean([abs(float(one.info["load"][i])) for one in seen]))


def _rises(way: list[tuple[float, float]], n: int) -> bool:
    """The last n loads are all above those of the slack tendon."""
    load = np.array(way)[:, 1]
    middle = np.median(load[:_FLAT])
    scatter = 1.4826 * float(np.median(np.abs(load[:_FLAT] - middle)))
    return len(load) >= _FLAT + n and bool((load[-n:] > middle + max(_RISES * scatter, _LEAST)).all())
