"""Dynamixel servos by model number: what their maker's tables say, and their drivers need.

Sources: ROBOTIS e-Manual, control tables of the X series and of MX(2.0); unit tables of its Dynamixel2Arduino
(2025). All have 4096 ticks a turn and the same addresses.
"""

from __future__ import annotations

from typing import NamedTuple


class Servo(NamedTuple):
    """A model with the control table of the X series."""

    name: str
    unit_ma: float = 0.0
    """Of Present Current, Goal Current and Current Limit [mA]; 0: it has Present Load [0.1 %] instead."""

    @property
    def modes(self) -> tuple[int, ...]:
        """Operating modes that take positions: 3 within one turn, 4 of many turns, 5 with a current, too."""
        return (3, 4, 5) if self.unit_ma else (3, 4)


_UNITS = {
    1.0: {
        1190: "XL330-M077", 1200: "XL330-M288",
        1210: "XC330-T181", 1220: "XC330-T288", 1230: "XC330-M181", 1240: "XC330-M288",
    },
    1.34: {1040: "XH430-V350", 1050: "XH430-V210"},
    2.69: {
        1000: "XH430-W350", 1001: "XD430-T350", 1010: "XH430-W210", 1011: "XD430-T210",
        1020: "XM430-W350", 1030: "XM430-W210",
        1100: "XH540-W270", 1101: "XD540-T270", 1110: "XH540-W150", 1111: "XD540-T150",
        1120: "XM540-W270", 1130: "XM540-W150", 1140: "XH540-V270", 1150: "XH540-V150",
        1170: "XW540-T260", 1180: "XW540-T140", 1270: "XW430-T333", 1280: "XW430-T200",
    },
    3.36: {311: "MX-64(2.0)", 321: "MX-106(2.0)"},
    0.0: {
        30: "MX-28(2.0)", 1060: "XL430-W250", 1070: "XC430-W150", 1080: "XC430-W240",
        1090: "2XL430-W250", 1160: "2XC430-W250",
    },
}  # fmt: skip
SERVOS = {number: Servo(name, unit) for unit, models in _UNITS.items() for number, name in models.items()}
"""Model number -> servo; one that is missing may be added."""
