"""Read TOML and XML of hands and objects strictly: what is unknown, of another type or not finite is an
error with a place."""

from __future__ import annotations

import math
import reprlib
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from .._files import read_text
from ..exceptions import DescriptionError

_NOTHING = object()
# what a description of a hand or an object never needs: a file may be a stranger's
_LARGEST_FILE = 64 * 1024  # bytes
_LONGEST_LINE = 4096  # characters: a dotted key stands on one line, and tomllib takes its square in time
_DEEPEST = 8  # tables and lists in each other
LARGEST_FIGURE = 1e9
#: Stands for a figure that is still to be filled in.
TODO = "TODO"


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The whole file as a dict, nested eight deep at most, with integers of 64 bits.

    Raises:
        DescriptionError: no such file, not UTF-8, not TOML, larger than 64 KiB, a line of more than 4096
            characters, or nested deeper.
    """
    text = toml_text(path, what)
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > _LONGEST_LINE:
            raise DescriptionError(path, f"line {number} has more than {_LONGEST_LINE} characters")
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also an integer of too many digits, and too deep lists
        raise DescriptionError(path, f"not well-formed TOML: {error}") from None
    _check_depth(path, data)
    return data


def toml_text(path: Path, what: str) -> str:
    """The file as text, of at most 64 KiB in UTF-8.

    Raises:
        DescriptionError: it is no such file.
    """
    return read_text(path, what, _LARGEST_FILE)


def _check_depth(path: Path, data: dict[str, Any]) -> None:
    """Level by level, since a recursion would end where the file wants it to."""
    level: list[Any] = [data]
    for _ in range(_DEEPEST):
        inside = []
        for value in level:
            if isinstance(value, dict | list):
                inside += value.values() if isinstance(value, dict) else value
            elif isinstance(value, int) and not -(2**63) <= value < 2**63:
                raise DescriptionError(path, "an integer does not fit into 64 bits")
        level = inside
    if level:
        raise DescriptionError(path, f"lists and tables are nested more than {_DEEPEST} deep")


class TomlTable:
    """One TOML table and where it stands. Angles: ``key`` in rad or ``key_deg`` in degrees, not both."""

    def __init__(self, path: Path, place: str, data: Any, valid: Iterable[str]) -> None:
        self.path, self.place = path, place
        if data is None:
            raise self.error("the table is missing")
        if not isinstance(data, dict):
            raise self.error(f"must be a table, got {_shown(data)}")
        self.data: dict[str, Any] = data
        valid = tuple(valid)
        for key in data:
            if key not in valid:
                raise self.error(f"unknown key '{key}'; valid keys are: {', '.join(valid)}")

    def error(self, problem: str) -> DescriptionError:
        return DescriptionError(self.path, f"{self.place}: {problem}")

    def _get(self, key: str, default: Any) -> Any:
        if key in self.data:
            return self.data[key]
        if default is _NOTHING:
            raise self.error(f"the key '{key}' is missing")
        return default

    def text(self, key: str, default: Any = _NOTHING) -> str:
        value = self._get(key, default)
        if not isinstance(value, str) or not value:
            raise self.error(f"'{key}' must be a non-empty string, got {_shown(value)}")
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self._get(key, default)
        if not isinstance(value, bool):
            raise self.error(f"'{key}' must be true or false, got {_shown(value)}")
        return value

    def number(
        self, key: str, default: Any = _NOTHING, minimum: float = -math.inf, positive: bool = False
    ) -> float:
        value = self._get(key, default)
        if value is default and key not in self.data:
            return float(default)
        value = self.finite(key, value)
        if value < minimum or (positive and value <= 0):
            valid = "positive" if positive else f"at least {minimum:g}"
            raise self.error(f"'{key}' must be {valid}, got {value:g}")
        return value

    def whole(self, key: str, default: Any = _NOTHING, least: int = 0) -> int:
        """A whole number of at least ``least``."""
        value = self.number(key, default, minimum=least)
        if value != int(value):
            raise self.error(f"'{key}' must be a whole number, got {value:g}")
        return int(value)

    def angle(self, key: str, default: Any = _NOTHING) -> float:
        """The angle under ``key`` [rad] or ``key_deg`` [deg], in rad."""
        if self._in_degrees(key):
            return math.radians(self.number(f"{key}_deg"))
        return self.number(key, default)

    def vector(self, key: str, size: int, default: Any = _NOTHING) -> tuple[float, ...]:
        return self.numbers(key, self._get(key, default), size)

    def numbers(self, key: str, value: Any, size: int) -> tuple[float, ...]:
        """``value``, which stands somewhere under ``key``."""
        if not isinstance(value, list | tuple) or len(value) != size:
            raise self.error(f"'{key}' must be a list of {size} numbers, got {_shown(value)}")
        return tuple(self.finite(key, entry) for entry in value)

    def angles(self, key: str, size: int, default: Any = _NOTHING) -> tuple[float, ...]:
        """A list of angles under ``key`` [rad] or ``key_deg`` [deg], in rad."""
        if self._in_degrees(key):
            return tuple(math.radians(value) for value in self.vector(f"{key}_deg", size))
        return self.vector(key, size, default)

    def weights(self, key: str, other: tuple[type, ...] = ()) -> dict[str, Any]:
        """A table of numbers, e.g. moment arms by joint name, or of ``other`` types; not empty."""
        value = self._get(key, _NOTHING)
        if not isinstance(value, dict) or not value:
            raise self.error(f"'{key}' must be a table of joint = number, got {_shown(value)}")
        return {
            name: entry if isinstance(entry, other) else self.finite(f"{key}.{name}", entry)
            for name, entry in value.items()
        }

    def _in_degrees(self, key: str) -> bool:
        both = [k for k in (key, f"{key}_deg") if k in self.data]
        if len(both) == 2:
            raise self.error(f"give either '{key}' [rad] or '{key}_deg', not both")
        return both == [f"{key}_deg"]

    def finite(self, key: str, value: Any) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.error(f"'{key}' must be a finite number, got {_shown(value)}")
        if abs(value) > LARGEST_FIGURE:
            raise self.error(f"'{key}' must be at most {LARGEST_FIGURE:g} in size, got {value:g}")
        return float(value)


def _shown(value: Any) -> str:
    """What stands in the file, not all of it."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 80
    return short.repr(value)


_MOST_NAMES = 6  # of a note
LARGEST = 4 << 20  # bytes of a file that describes a hand or an object


def read_xml(path: Path, what: str, *roots: str) -> ET.Element:
    """The root element, which is one of ``roots``. Text is UTF-8, whatever the file declares.

    Raises:
        DescriptionError: no such file, more than 4 MiB, not UTF-8, malformed, or another root.
    """
    text = read_text(path, what, LARGEST)
    try:
        root = ET.fromstring(text)  # fetches no external entity, refuses those that blow up
    except (ET.ParseError, ValueError) as error:
        hint = "; of a file with macros run first: xacro" if "<xacro:" in text else ""
        raise DescriptionError(path, f"not well-formed XML: {error}{hint}") from None
    if any("xacro" in element.tag for element in root.iter()):
        raise DescriptionError(path, f"holds macros; run first: xacro {path} > NEW{path.suffix}")
    if root.tag not in roots:
        raise DescriptionError(path, f"the root element must be <{roots[0]}>, found <{root.tag}>")
    return root


def listed(note: str, names: Sequence[str]) -> str:
    """A note on several things: ``"note: a, b"``, and how many more there are."""
    more = len(names) - _MOST_NAMES
    return f"{note}: {', '.join(names[:_MOST_NAMES])}" + (f" and {more} more" if more > 0 else "")
