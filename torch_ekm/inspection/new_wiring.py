"""A wiring file from what answers on a bus."""

from __future__ import annotations

import math

import numpy as np

from ..description import load_hand
from ..drivers import SERVOS
from ..drivers.dynamixel import Registers, registers
from ..drivers.dynamixel_port import DynamixelPort
from ..exceptions import BusError

BAUDS = (57600, 1000000, 4000000, 3000000, 2000000, 115200, 9600)
_TURN = 4096
_BY_HAND = "without a bus: write it as docs/how_to/drive_a_t42.md does, and try 'check --plant --emulate'"
_HEAD = """\
# Written from a scan: check it with torch-ekm check --plant.
[hand]
driver = "dynamixel"
description = "{hand}"

[bus]
port = "{port}"
baud = {baud}
{current}
[limits]
increment_deg = 10
rate_deg = 60
"""
_MOTOR = """
[[motors]]       # {servo}
# in the order of ids: a guess
name = "{name}"
id = {id}
# -1 where the servo counts the other way
sign = 1
# as it stood when scanned, the hand at rest; tendons: torch-ekm slack --write
zero = {zero}
"""


def new_wiring(port: str, hand: str, bauds: tuple[int, ...] = BAUDS) -> str:
    """Text of a wiring file for the Dynamixel servos that answer, in the order of their ids.

    Nothing is written to a servo. Zeros are where the motors stand: put the hand at rest first.

    Args:
        port: such as /dev/ttyUSB0.
        hand: its description.
        bauds: are tried one after the other, until a servo answers.

    Raises:
        BusError: no servo answers, or not as many as the hand has actuators; the message lists them.
        UnknownNameError, DescriptionError: there is no such hand.
    """
    description = load_hand(hand).counted()
    for baud in bauds:
        try:
            bus = DynamixelPort(port, baud)
        except BusError as error:
            raise BusError(port, f"{error.problem}; {_BY_HAND}") from error
        try:
            if ids := bus.scan():
                found = registers(bus, ids)
                break
        finally:
            bus.close()
    else:
        raise BusError(port, f"no servo answers at {', '.join(map(str, bauds))} baud: is it powered?")
    names, models = description.actuator_names, [SERVOS.get(one["Model Number"]) for one in found]
    said = [f"id {k}: {one.name if one else 'unknown'}" for k, one in zip(ids, models, strict=True)]
    if len(ids) != len(names):
        problem = f"{len(ids)} servos answer at {baud} baud ({', '.join(said)})"
        raise BusError(port, f"{problem}; {hand} has {len(names)} actuators: {', '.join(names)}")
    rest = np.clip(description.spring_rest, description.joint_lower, description.joint_upper)
    a = description.unloaded(rest)
    most = min(
        one["Current Limit"] * (model.unit_ma if model else 0)
        for one, model in zip(found, models, strict=True)
    )
    current = (
        f"# current_ma = ...  # the most that a motor pulls with; they allow {most:.0f} mA\n" if most else ""
    )
    motors = [
        _MOTOR.format(
            servo=f"{text.partition(': ')[2]}, firmware {one['Firmware Version']}", name=name, id=k,
            zero=round(one["Present Position"] - float(at) * _TURN / (2 * math.pi)),
        ) + _range(one)
        for name, k, text, one, at in zip(names, ids, said, found, a, strict=True)
    ]  # fmt: skip
    return _HEAD.format(hand=hand, port=port, baud=baud, current=current) + "".join(motors)


def _range(found: Registers) -> str:
    low, high = found["Min Position Limit"], found["Max Position Limit"]
    if (low, high) == (0, _TURN - 1):
        return ""
    return f"# its Position Limits are {low} and {high} ticks: they hold in mode 3 alone\n"
