"""The driver that a wiring file is for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..description import HandDescription
from ..exceptions import UnknownNameError
from .driver import HandDriver
from .dynamixel import DynamixelPlant
from .emulated import EmulatedPlant
from .ros2 import Ros2Plant
from .wiring import driver_of
from .yarp import YarpPlant

DRIVERS = {"dynamixel": DynamixelPlant, "ros2": Ros2Plant, "yarp": YarpPlant}


def open_driver(
    wiring: str | Path, hand: HandDescription | None = None, *, emulate: bool = False, **options: Any
) -> HandDriver:
    """The driver that ``[hand] driver`` names, connected to its bus.

    Args:
        wiring: the TOML file.
        hand: its description; None: the one that the file names.
        emulate: no bus is opened: an :class:`EmulatedPlant`.
        options: see :class:`HandDriver`.

    Raises:
        UnknownNameError: there is no such driver; the message lists them.
        DescriptionError: the file is wrong; the message names the line.
        BusError: a device does not answer.
    """
    name = driver_of(wiring)
    if name not in DRIVERS:
        raise UnknownNameError("driver", name, DRIVERS)
    driver = DRIVERS[name]
    if emulate:
        return EmulatedPlant(driver.wired(wiring, hand), driver.unit, **options)
    return driver(wiring, hand, **options)
