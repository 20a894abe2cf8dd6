from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .._checks import check_positive
from ..description import Actuator, HandDescription, load_hand
from ..description._reading import TomlTable, read_toml, toml_text
from ..description.registry import HAND_FILES
from ..exceptions import DescriptionError, ParameterError, UnknownNameError

_TABLES = ("hand", "bus", "motors", "joints", "fingertips", "limits")
_HAND = ("driver", "description")
_CHANNEL = ("name", "id", "sign", "zero", "per_rad")
_MOTOR = (*_CHANNEL, "range", "range_deg")
_FINGERTIP = ("name", "id", "count", "zero", "per_newton")
_ANGLES = ("increment", "rate", "still")  # of the limits
_MOST = {  # [rad, rad/s], [s]; more was meant in deg, or in ms
    "increment": math.pi, "rate": 30.0, "still": 0.1, "still_for": 10.0, "timeout": 200.0, "period": 2.0,
}  # fmt: skip
_HEADER = re.compile(r"^\s*(\[\[?)\s*([\w.-]+)\s*\]")
_KEY = re.compile(r"""^\s*["']?([\w-]+)["']?\s*=""")
_QUOTED = re.compile(r"'([\w-]+)'")


@dataclass(frozen=True)
class Channel:
    """One number of the bus, and the quantity that it stands for: ``bus = zero + sign per_unit value``."""

    name: str
    """Of the actuator, joint or pad in the description."""
    id: int | str
    """Servo's number, axis, place in a message, or name on the bus."""
    sign: int = 1
    zero: float = 0.0
    """What the bus reads where the quantity is 0 [bus units]."""
    per_unit: float = 1.0
    """Bus units per rad or N."""
    lower: float = -math.inf
    """A motor is commanded to no less [rad]."""
    upper: float = math.inf
    count: int = 1
    """A fingertip's force is the sum of so many taxels, the first at ``id``."""
    lines: Mapping[str, int] = field(default_factory=dict, compare=False)
    """Line of each of its keys in the wiring file; "" is where it begins."""

    def line(self, key: str = "") -> int:
        """Line of a key, or where the channel begins; 0: it is in no file."""
        return self.lines.get(key, self.lines.get("", 0))

    def value(self, bus: float) -> float:
        """What a reading means [rad, N]."""
        return self.sign * (bus - self.zero) / self.per_unit

    def bus(self, value: float) -> float:
        """What is written for a position [rad]."""
        return self.zero + self.sign * self.per_unit * value


@dataclass(frozen=True)
class Limits:
    """What a driver allows, and when it calls a hand at rest; angles [rad], times [s].

    Raises:
        ParameterError: a figure is not positive.
    """

    increment: float = math.radians(20)
    """Largest command to a motor; a larger one is refused."""
    rate: float = math.radians(60)
    """Of a motor [rad/s]."""
    still: float = math.radians(0.2)
    """A hand rests when no motor moves more than this within ``still_for``."""
    still_for: float = 0.1
    timeout: float = 3.0
    """A motion that takes longer, on top of its distance over ``rate``, never comes to rest."""
    period: float = 0.02
    """Between two messages of the slowest sensor; a reading older than two is stale."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_positive(name, value)


class LinedTable(TomlTable):
    """A table whose errors name the line: of the key that the problem quotes, else of the table's head."""

    def __init__(
        self, path: Path, place: str, data: Any, valid: Iterable[str], lines: Mapping[str, int]
    ) -> None:
        self.lines = lines
        super().__init__(path, place, data, valid)

    def where(self, key: str) -> str:
        """A key, and the line where it stands, or its table."""
        return f"'{key}' ({self.path}:{self.lines.get(key, self.lines.get('', 0))})"

    def error(self, problem: str) -> DescriptionError:
        named = (key for name in _QUOTED.findall(problem) for key in (name, f"{name}_deg"))
        keys = (key for key in named if key in self.lines)
        line = self.lines.get(next(keys, ""), 0)
        return DescriptionError(f"{self.path}:{line}" if line else self.path, f"{self.place}: {problem}")


@dataclass(frozen=True)
class Wiring:
    """How a hand's motors and sensors are wired: its TOML file, read and checked.

    Channels are in the order of the description. :meth:`read` makes one.
    """

    path: Path
    driver: str
    hand: HandDescription
    motors: tuple[Channel, ...]
    joints: tuple[Channel, ...]
    """Of the joints that have a sensor."""
    fingertips: tuple[Channel, ...]
    """Of all pads, or none."""
    limits: Limits
    bus: LinedTable
    """The table ``[bus]``, whose keys are the driver's."""

    @classmethod
    def read(
        cls,
        path: str | Path,
        driver: str,
        per_rad: float,
        bus: Iterable[str],
        *,
        named: bool = False,
        hand: HandDescription | None = None,
    ) -> Wiring:
        """Read a wiring file.

        Args:
            path: of the TOML file.
            driver: that it must be for.
            per_rad: the bus's units per rad, where the file does not say.
            bus: valid keys of ``[bus]``.
            named: channels are called by names, not by numbers.
            hand: its description; None: the one that the file names.

        Raises:
            DescriptionError: the file is missing or wrong; the message names line and remedy.
        """
        path = Path(path)
        data, lines, head = _opened(path)
        top = LinedTable(path, "file", data, _TABLES, {name: at.get("", 0) for name, at in lines.items()})
        if head.text("driver") != driver:
            raise head.error(f"'driver' is '{head.text('driver')}', this is the driver '{driver}'")
        if hand is None:
            name = head.text("description")
            beside = path.parent / name
            try:
                hand = load_hand(beside if beside.suffix in HAND_FILES else name).counted()
            except UnknownNameError as error:
                raise head.error(f"'description': {error}") from None

        def channel(kind: str, valid: tuple[str, ...], names: tuple[str, ...], unit: float) -> list[Channel]:
            entries = top.data.get(kind, [])
            if not isinstance(entries, list):
                raise top.error(f"'{kind}' must be written as [[{kind}]], a table for each")
            tables = (
                LinedTable(path, f"[[{kind}]]", one, valid, lines.get(f"{kind} {k}", {}))
                for k, one in enumerate(entries)
            )
            found = [_channel(table, hand, names, named, unit) for table in tables]
            for what in ("name", "id"):
                _unique(path, kind, what, found)
            return sorted(found, key=lambda one: names.index(one.name))

        motors = channel("motors", _MOTOR, hand.actuator_names, per_rad)
        joints = channel("joints", _CHANNEL, hand.joint_names, per_rad)
        pads = tuple(pad.name for pad in hand.pads)
        fingertips = channel("fingertips", _FINGERTIP, pads, 1.0)
        for kind, found, needed in (
            ("motors", motors, hand.actuator_names),
            ("fingertips", fingertips, pads),
        ):
            missing = [name for name in needed if name not in [one.name for one in found]]
            if missing and (found or kind == "motors"):
                raise DescriptionError(path, f"[[{kind}]]: there is none for {', '.join(missing)}")
        known = vars(Limits())
        valid = (*known, *(f"{key}_deg" for key in _ANGLES))
        given = LinedTable(path, "[limits]", data.get("limits", {}), valid, lines.get("limits", {}))
        read = {key: given.angle if key in _ANGLES else given.number for key in known}
        figures = {key: read[key](key, default) for key, default in known.items()}
        for key, most in _MOST.items():
            if figures[key] > most:
                unit = "rad/s" if key == "rate" else "rad" if key in _ANGLES else "s"
                problem = f"'{key}' must be at most {most:.3g} {unit}, got {figures[key]:.4g}"
                raise given.error(problem + (f"; '{key}_deg' is in deg" if key in _ANGLES else ""))
        try:
            limits = Limits(**figures)
        except ParameterError as error:
            raise given.error(f"'{error.name}' must be {error.valid}, got {error.value}") from None
        table = LinedTable(path, "[bus]", data.get("bus", {}), bus, lines.get("bus", {}))
        return cls(path, driver, hand, tuple(motors), tuple(joints), tuple(fingertips), limits, table)

    def error(self, kind: str, one: Channel, problem: str, key: str = "") -> DescriptionError:
        """Of a motor, joint or fingertip, with the line of a key or of its table's head."""
        return DescriptionError(f"{self.path}:{one.line(key)}", f"[[{kind}]] '{one.name}': {problem}")

    def line(self, kind: str, name: str, key: str = "") -> int:
        """Line of a key of the motor, joint or fingertip ``name``, or of its table's head; 0: it has none."""
        return next((one.line(key) for one in getattr(self, kind) if one.name == name), 0)


def driver_of(path: str | Path) -> str:
    """Which driver a wiring file is for.

    Raises:
        DescriptionError: the file is missing or wrong.
    """
    return _opened(Path(path))[2].text("driver")


def _opened(path: Path) -> tuple[dict[str, Any], dict[str, dict[str, int]], LinedTable]:
    """What stands in the file, in which lines, and its table ``[hand]``."""
    data, lines = read_toml(path, "wiring file"), _lines(toml_text(path, "wiring file"))
    return data, lines, LinedTable(path, "[hand]", data.get("hand"), _HAND, lines.get("hand", {}))


def _channel(
    table: LinedTable, hand: HandDescription, names: tuple[str, ...], named: bool, per_rad: float
) -> Channel:
    name = table.text("name")
    if name not in names:
        raise table.error(f"'name': the description has no '{name}'; it has: {', '.join(names)}")
    table.place += f" '{name}'"
    place = None if named and not isinstance(table.data.get("id"), int) else table.whole("id")
    sign = table.number("sign", 1)
    if sign not in (1, -1):
        raise table.error(f"'sign' must be 1 or -1, got {sign:g}")
    lower, upper, unit = -math.inf, math.inf, 1.0
    if names == hand.actuator_names:
        own = hand.actuators[names.index(name)]
        lower, upper = _range(table, own)
        unit = own.unit if "per_rad" in table.data else 1.0  # the file counts as the description's does
    return Channel(
        name=name,
        id=table.text("id", name) if place is None else str(place) if named else place,
        sign=int(sign),
        zero=table.number("zero", 0.0),
        per_unit=unit
        * table.number("per_newton" if "per_newton" in table.data else "per_rad", per_rad, positive=True),
        lower=lower,
        upper=upper,
        count=table.whole("count", 1, least=1),
        lines=table.lines,
    )


def _range(table: LinedTable, own: Actuator) -> tuple[float, float]:
    """Of a motor [rad]: that of the description, or a part of it."""
    lower, upper = table.angles("range", 2, (own.lower * own.unit, own.upper * own.unit))
    lower, upper = lower / own.unit, upper / own.unit
    key = "range_deg" if "range_deg" in table.data else "range"
    shown = [f"{math.degrees(x):.4g}" for x in (lower, upper, own.lower, own.upper)]
    if lower >= upper:
        raise table.error(f"'{key}' is turned round or empty, {shown[0]} to {shown[1]} deg")
    if lower < own.lower - 1e-9 or upper > own.upper + 1e-9:
        allowed = f"the description allows {shown[2]} to {shown[3]} deg"
        raise table.error(f"'{key}' is {shown[0]} to {shown[1]} deg, {allowed}")
    return lower, upper


def _unique(path: Path, kind: str, what: str, found: list[Channel]) -> None:
    first: dict[Any, Channel] = {}
    for one in found:
        value = getattr(one, what)
        other = first.setdefault(value, one)
        if other is not one:
            place = f"'{other.name}', line {other.line()}" if what == "id" else f"line {other.line()}"
            problem = f"{what} {value!r} is that of {place}, too; each has its own"
            raise DescriptionError(f"{path}:{one.line(what)}", f"[[{kind}]] '{one.name}': {problem}")


def _lines(text: str) -> dict[str, dict[str, int]]:
    """Table -> key -> line; entries of lists of tables are called "motors 0", "motors 1", ..."""
    found: dict[str, dict[str, int]] = {}
    count: dict[str, int] = {}
    table = found.setdefault("", {})
    for number, line in enumerate(text.split("\n"), 1):
        if (head := _HEADER.match(line)) is not None:
            name = head[2]
            if head[1] == "[[":
                found.setdefault(name, {"": number})
                count[name] = count.get(name, -1) + 1
                name = f"{name} {count[name]}"
            table = found.setdefault(name, {"": number})
        elif (key := _KEY.match(line)) is not None:
            table.setdefault(key[1], number)
    return found
