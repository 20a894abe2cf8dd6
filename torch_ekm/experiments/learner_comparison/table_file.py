"""A table of numbers from a CSV or Parquet file; whatever is wrong is named with its line and column."""

from __future__ import annotations

import contextlib
import csv
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ... import interop
from ..._extras import require
from ...exceptions import DescriptionError, ParameterError, UnknownNameError
from ...typing import Array

Names = tuple[str, ...]
_BAGS = (".mcap", ".db3", ".bag")
_TIME = re.compile(r"(time|timestamp|stamp)([ _]?[\[(]?(s|ms|us|ns|sec|seconds)[\])]?)?", re.IGNORECASE)


class Rows(NamedTuple):
    """Rows of a table in which nothing is missing, in the order of time."""

    values: Array
    """``(n_rows, n)`` of the columns that were asked for."""
    part: NDArray[np.integer[Any]]
    """Number of each row's unbroken part: another begins with a run, and after rows that are left out."""
    about: str = ""
    """Which rows are left out and why, and what was found of clocks; sentences that begin with a blank."""


#: Values ``(n_rows, n)`` of the n columns that it is given.
Read = Callable[[Sequence[str]], Array]


def open_table(
    path: Path, clock: str | None = None, label: str = ""
) -> tuple[Names, Callable[[Sequence[str]], Rows]]:
    """Column names, and a function that reads some of the columns, rows in the order of time.

    CSV (``.csv``, ``.tsv``, ``.txt``): UTF-8, separated by comma, semicolon or tab; the first line names the
    columns, every other field is a number with a decimal point. Parquet (``.parquet``): every column is
    numeric. Nothing may be missing: a learner cannot guess what a hole means. Columns that are not read may
    hold anything; a first one without a name, which pandas writes as its index, is skipped. In the column
    ``label`` each text counts as a number of its own.

    A recording of ROS (MCAP, sqlite3, .bag, the folder of rosbag2) has a row for each message of the topic
    ``clock``.

    Raises:
        DescriptionError: the file cannot be used; the message names line (row) and column. The function
            raises it, too.
        ParameterError: a recording of ROS without ``clock``.
        UnknownNameError: the recording has no such topic; the message lists them.
    """
    readers = {".csv": _csv, ".tsv": _csv, ".txt": _csv, ".parquet": _parquet, ".pq": _parquet}
    kind = path.suffix.lower()
    if kind not in readers and (path.is_dir() or kind in _BAGS):
        if clock is None:
            raise ParameterError(
                "clock", clock, "a topic whose messages set the rows, such as that of the commands"
            )
        bag = interop.read_bag(path, clock)
        return bag.names, partial(_bag_rows, path, bag)
    if not path.is_file():
        raise DescriptionError(path, "there is no such file")
    if kind not in readers:
        raise DescriptionError(path, f"files of kind '{path.suffix}' are not read; use .csv or .parquet")
    names, read = readers[kind](path, label)
    names = names[1:] if names[:1] == ("",) else names
    for i, name in enumerate(names):
        if not name:
            raise DescriptionError(path, f"column {i + 1} has no name in the header")
        if name in names[:i]:
            raise DescriptionError(path, f"two columns are called '{name}'")
    return names, partial(_file_rows, names, read)


def _file_rows(names: Names, read: Read, wanted: Sequence[str]) -> Rows:
    """Another run begins where a column that is called time goes back."""
    values = read(wanted)
    part, about = np.zeros(len(values), dtype=int), ""
    for clock in [name for name in names if _TIME.fullmatch(name)][:1]:
        with contextlib.suppress(DescriptionError):  # dates, or with holes
            back = np.diff(read([clock])[:, 0]) < 0
            if 20 * back.sum() > len(back):
                first = int(back.argmax()) + 2
                problem = f"goes back in {back.sum()} of {len(values)} rows, first in row {first}"
                about = f" Column '{clock}' {problem}: rows should be in the order of time."
            elif back.any():
                part = np.append(0, back.cumsum())
                about = f" {part[-1] + 1} runs: column '{clock}' goes back."
    return Rows(values, part, about)


def _bag_rows(path: Path, bag: interop.BagTable, wanted: Sequence[str]) -> Rows:
    """The complete ones."""
    at = [bag.names.index(name) for name in wanted]
    values, n = bag.values[:, at], len(bag.time)
    missing = ~np.isfinite(values)
    kept = np.flatnonzero(~missing.any(axis=1))
    why: dict[str, list[str]] = {}  # columns of one topic mostly miss alike
    for name, gone in dict(zip(wanted, missing.T, strict=True)).items():
        if gone.any():
            why.setdefault(f"{name.partition('.')[0]}*{_gaps(gone, bag.time)}", []).append(name)
    because = [
        (names[0] if len(names) == 1 else f"{text.partition('*')[0]} ({len(names)} columns, {names[0]})")
        + text.partition("*")[2]
        for text, names in why.items()
    ]
    left = f"{len(kept)} of {n} rows, because {', '.join(because)}"
    if not len(kept):
        raise DescriptionError(path, f"{left}: leave such columns out")
    broken = (np.diff(kept) > 1) | (np.diff(bag.run[kept]) != 0)
    notes = [*bag.notes, *([left] if because else [])]
    return Rows(values[kept], np.append(0, broken.cumsum()), "".join(f" {one}." for one in notes))


def _gaps(gone: NDArray[np.bool_], time: Array) -> str:
    """When a column has no finite value, in words."""
    there = np.flatnonzero(~gone)
    if not len(there):
        return " has no finite value"
    first, last = there[0], there[-1]
    if gone.sum() == first:
        return f" begins at {time[first]:.4g} s"
    if gone.sum() == len(gone) - 1 - last:
        return f" ends at {time[last]:.4g} s"
    return f" is silent or not finite in {gone.sum()} rows, first at {time[gone.argmax()]:.4g} s"


def find_columns(wanted: str | Sequence[str], names: Sequence[str]) -> list[str]:
    """Names of the columns, in the order in which they are asked for; ``begin*``: all that begin so.

    A single name stands for a list of one.

    Raises:
        UnknownNameError: there is no such column; the message lists the columns.
    """
    found: list[str] = []
    for pattern in [wanted] if isinstance(wanted, str) else wanted:
        begin = pattern.removesuffix("*")
        fits = [name for name in names if name == pattern or (begin != pattern and name.startswith(begin))]
        if not fits:
            raise UnknownNameError("column", pattern, names)
        found += [name for name in fits if name not in found]
    return found


def _csv(path: Path, label: str) -> tuple[Names, Read]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DescriptionError(path, f"byte {error.start} is not UTF-8; save it as CSV in UTF-8") from None
    lines = text.splitlines()
    first = next((line for line in lines if line.strip()), None)
    if first is None:
        raise DescriptionError(path, "the file is empty")
    reader = csv.reader(lines, delimiter=max(",;\t", key=first.count))
    rows = [(reader.line_num, [field.strip() for field in row]) for row in reader if row]
    number, names = rows[0]
    if all(_number(field) is not None for field in names):
        problem = "holds numbers only; the first line must name the columns"
        raise DescriptionError(path, f"line {number} {problem}")
    for line, row in rows:
        if len(row) != len(names):
            problem = f"has {len(row)} fields, but the header names {len(names)} columns"
            raise DescriptionError(path, f"line {line} {problem}")
    if label in names:
        place = names.index(label)
        numbers = _numbers([row[place] for _, row in rows[1:]])
        for (_, row), number in zip(rows[1:], numbers, strict=True):
            row[place] = number
    return tuple(names), partial(_csv_values, path, names, rows[1:])


def _csv_values(
    path: Path, names: list[str], rows: list[tuple[int, list[str]]], columns: Sequence[str]
) -> Array:
    places = [names.index(name) for name in columns]
    values = np.array([[_number(row[place]) for place in places] for _, row in rows], dtype=np.float64)
    values = values.reshape(len(rows), len(places))  # np.float64 makes a NaN of None
    bad = ~np.isfinite(values)
    if bad.any():
        i, j = np.argwhere(bad)[0]
        line, row = rows[i]
        field = row[places[j]]
        problem = f": '{field}' is not finite; fill it in, or leave the whole line out"
        if _number(field) is None:
            problem = f": '{field}' is no number; encode it, or leave the column or the line out"
        if _number(field.replace(",", ".", 1)) is not None and "," in field:
            problem = f": '{field}' has a decimal comma; write a point"
        if not field:
            problem = " is empty; fill it in, or leave the whole line out"
        n = int(bad.any(1).sum())
        more = f". {n} of {len(rows)} lines have a field that is no finite number" if n > 1 else ""
        raise DescriptionError(path, f"line {line}, column '{columns[j]}'{problem}{more}")
    return values


def _numbers(texts: Sequence[str | None]) -> list[str]:
    """As they are if all are figures; else each text gets a number, and what is empty stays empty."""
    known = [text or "" for text in texts]
    if all(_number(text) is not None for text in known if text):
        return known
    number_of = {text: str(number) for number, text in enumerate(dict.fromkeys(filter(None, known)))}
    return [number_of.get(text, "") for text in known]


def _number(field: str) -> float | None:
    try:
        return float(field)
    except ValueError:
        return None


def _parquet(path: Path, label: str) -> tuple[Names, Read]:
    parquet, pyarrow = require("pyarrow.parquet"), require("pyarrow")
    try:
        table = parquet.read_table(path)
    except pyarrow.ArrowInvalid as error:
        raise DescriptionError(path, f"this is no Parquet file ({error})") from None

    def values(name: str) -> Array:
        column = table.column(name)
        kind = column.type
        if name == label and (pyarrow.types.is_string(kind) or pyarrow.types.is_large_string(kind)):
            numbers = _numbers(column.to_pylist())
            column = pyarrow.chunked_array([[float(number) if number else None for number in numbers]])
            kind = column.type
        if not (pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind)):
            problem = f"holds {kind}, not numbers; leave it out or encode it"
            raise DescriptionError(path, f"column '{name}' {problem}")
        found = column.to_numpy().astype(np.float64)
        if column.null_count or not np.isfinite(found).all():
            row = int(np.flatnonzero(~np.isfinite(found))[0])
            raise DescriptionError(path, f"row {row + 1}, column '{name}' is empty or not finite")
        return found

    def read(columns: Sequence[str]) -> Array:
        return np.stack([values(name) for name in columns], -1) if columns else np.empty((len(table), 0))

    return tuple(table.column_names), read
