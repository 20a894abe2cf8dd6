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
from ..drivers import HandDriver, Wiring
from ..exceptions import DescriptionError, DeviceError
from ..typing import Array

_STEP = math.radians(1)
_LOOKS = 5  # readings of the load after each step
_FLAT, _RISING = 5, 8  # steps: of the slack tendon at least; above these until it is called taut
_RISES, _LEAST = 6.0, 2.0  # a load rises by more than so many standard deviations, and units of the bus


class Taut(NamedTuple):
    """A motor whose tendon was found."""

    motor: str
    zero: float
    """What the bus reads at position 0: the ``zero`` of the wiring file."""
    std: float
    """Of it, by the scatter of the loads [bus units]."""
    closed: float
    """How far it closed [rad]; it went back."""


def find_slack(driver: HandDriver, *, on_step: Callable[[str], object] = lambda text: None) -> list[Taut]:
    """``load(a) = c + k max(0, a - a_taut)``: each motor closes by 1 deg at a time until its load rises.

    The tendon is then taut with the finger at its rest, where the description has ``a = a_0 + J_a q_0``:
    this gives the motor's ``zero``. Begin with slack tendons and an empty hand. Positions count from where a
    motor stands, so it goes no farther than its range is long; each goes back before the next one closes.
    Motors that shape the hand are left out.

    Args:
        driver: whose bus tells loads.
        on_step: is told what happens.

    Raises:
        DeviceError: the bus tells no loads; a tendon is taut from the start, or never; a step is refused.
    """
    hand, given = driver.hand, driver.wiring
    at_rest = np.clip(hand.spring_rest, hand.joint_lower, hand.joint_upper)
    taut = hand.actuator_offset + hand.actuation_jacobian @ at_rest
    bus = given.motors
    stands = [one.bus(float(a)) for one, a in zip(bus, driver.observe().a, strict=True)]
    found = []
    try:
        here = [
            replace(one, zero=at - one.bus(one.lower) + one.zero) for one, at in zip(bus, stands, strict=True)
        ]
        driver.wiring = replace(given, motors=tuple(here))
        for i, actuator in enumerate(hand.actuators):
            if not actuator.posture:
                a, std, closed = _close(driver, i, on_step)
                zero = here[i].bus(a - float(taut[i]))
                found.append(Taut(actuator.name, zero, std * here[i].per_unit, closed))
                on_step(f"{actuator.name}: taut after {math.degrees(closed):.1f} deg")
    finally:
        driver.wiring = given
    return found


def write_zeros(wiring: Wiring, found: list[Taut]) -> None:
    """Write them into the wiring file, whose other lines and comments stay as they are.

    Raises:
        DescriptionError: a motor's table is not found in it.
        OutputError: it cannot be written.
    """
    lines = wiring.path.read_text(encoding="utf-8").splitlines()
    at = {one: wiring.line("motors", one.motor, "zero") for one in found}
    for one, number in sorted(at.items(), key=lambda pair: -pair[1]):
        if not number:
            raise DescriptionError(wiring.path, f"no [[motors]] table of '{one.motor}': write its zero there")
        text = f"zero = {one.zero:.6g}"
        if re.match(r"\s*zero\s*=", lines[number - 1]):
            lines[number - 1] = re.sub(r"zero\s*=\s*[^#\s]+", text, lines[number - 1])
        else:
            lines.insert(number, text)  # below the table's head
    write_whole(wiring.path, "\n".join(lines) + "\n")


def _close(driver: HandDriver, i: int, on_step: Callable[[str], object]) -> tuple[float, float, float]:
    """Where the tendon of motor i is taut, its standard deviation, and how far the motor closed [rad]."""
    name, upper = driver.hand.actuator_names[i], driver.wiring.motors[i].upper
    step, most = min(_STEP, driver.limits.increment), min(4 * _STEP, driver.limits.increment)
    way = [_position_and_load(driver, i)]
    delta = torch.zeros(driver.hand.n_a, dtype=torch.float64)
    delta[i] = step
    try:
        while not _rises(way, _RISING):
            if way[-1][0] > upper - float(delta[i]):
                raise DeviceError(f"motor '{name}'", "closed by all of its range, and its load never rose")
            driver.command(delta)
            way.append(_position_and_load(driver, i))
            on_step(f"{name}: {math.degrees(way[-1][0] - way[0][0]):.1f} deg, load {way[-1][1]:.3g}")
            if way[-1][0] - way[-2][0] < step / 4:  # a dead zone, or all that its current can pull
                if _rises(way, 3):
                    break
                if delta[i] == most:
                    raise DeviceError(f"motor '{name}'", "does not move, and its load does not rise")
                delta[i] = min(2 * float(delta[i]), most)
    finally:
        closed = way[-1][0] - way[0][0]
        for _ in range(pieces := math.ceil(closed / driver.limits.increment)):
            delta[i] = -closed / pieces
            driver.command(delta)
    a, load = np.array(way).T
    at, std = _hinge(a, load)
    if at < a[2]:
        problem = "its load rises from the start: let the tendon out until it is slack, then once more"
        raise DeviceError(f"motor '{name}'", problem)
    return at, std, closed


def _position_and_load(driver: HandDriver, i: int) -> tuple[float, float]:
    seen = [driver.observe() for _ in range(_LOOKS)]
    if not seen[-1].info["load"]:
        raise DeviceError(driver.wiring.path.name, "the bus tells no loads of the motors: set zeros by hand")
    loads = [abs(float(one.info["load"][i])) for one in seen]
    return float(seen[-1].a[i]), float(np.mean(loads))


def _rises(way: list[tuple[float, float]], n: int) -> bool:
    """The last n loads are all above those of the slack tendon."""
    load = np.array([one[1] for one in way])
    flat = load[:_FLAT]
    middle = np.median(flat)
    scatter = 1.4826 * float(np.median(np.abs(flat - middle)))
    return len(load) >= _FLAT + n and bool((load[-n:] > middle + max(_RISES * scatter, _LEAST)).all())


def _hinge(a: Array, load: Array) -> tuple[float, float]:
    """The knot of ``c + k max(0, a - knot)`` by least squares, and its standard deviation."""
    knots = np.linspace(a[0], a[-2], 40 * len(a))
    squares = []
    for knot in knots:
        X = np.stack([np.ones_like(a), np.maximum(0, a - knot)], axis=1)
        squares.append(float(np.square(load - X @ np.linalg.lstsq(X, load, rcond=None)[0]).sum()))
    least = int(np.argmin(squares))
    as_good = knots[np.array(squares) <= squares[least] * (1 + 1 / max(1, len(a) - 3))]
    return float(knots[least]), float(as_good.max() - as_good.min()) / 2
