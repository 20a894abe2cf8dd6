"""A table of numbers from a file; whatever is wrong is named with its line and column."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ... import interop
from ..._extras import require
from ..._files import check_announced, check_file, told_as_damage
from ...exceptions import DescriptionError, ParameterError, UnknownNameError
from ...typing import Array
from .csv_file import Names, Read, labels, open_csv

_BAGS = (".mcap", ".db3", ".bag")
_CSV, _PARQUET = (".csv", ".tsv", ".txt"), (".parquet", ".pq")
_LARGEST_PARQUET = 4 << 30  # bytes
_MOST_COLUMNS = 4096
_INDEXED = re.compile(r"(.+)\[([0-9]{1,4})\]")
_TIME = re.compile(  # also %time of ROS 1, __time of PlotJuggler, header.stamp
    r"(.*[./])?[%_]*(time|timestamp|stamp)([ _]?[\[(]?(s|ms|us|ns|sec|seconds)[\])]?)?", re.IGNORECASE
)
_TIME_WORD = re.compile(  # in a name, as sim_time, rosbagTimestamp, t [s]; nanosec begins anew each second
    r"(?!.*n(ano)?sec)((.*[./])?t|(.*[^a-z])?([a-z]*time|[a-z]*stamp|secs?|seconds?|elapsed|clock))([^a-z].*)?",
    re.IGNORECASE,
)


class Rows(NamedTuple):
    """Rows of a table in which nothing is missing, in the order of time."""

    values: Array
    """``(n_rows, n)`` of the columns that were asked for."""
    part: NDArray[np.integer[Any]]
    """Number of each row's unbroken part: another begins with a run, and after rows that are left out."""
    about: str = ""
    """Which rows are left out and why, and what was found of clocks; sentences that begin with a blank."""


Reader = Callable[[Sequence[str]], Rows]


def open_table(path: Path, clock: str | None = None, label: str = "") -> tuple[Names, Reader]:
    """Column names, and a function that reads some of the columns, rows in the order of time.

    CSV (``.csv``, ``.tsv``, ``.txt``), see :func:`open_csv`, or Parquet (``.parquet``), see
    :func:`open_parquet`, of at most 4096 columns. Nothing may be missing: a learner cannot guess what a hole
    means. Columns that are not read may hold anything; a first one without a name, which pandas writes as
    its index, is skipped. In the column ``label`` each text counts as a number of its own.

    A recording of ROS (MCAP, sqlite3, .bag, the folder of rosbag2) has a row for each message of the topic
    ``clock``.

    Raises:
        DescriptionError: the file cannot be used; the message names line (row) and column. The function
            raises it, too.
        ParameterError: a recording of ROS without ``clock``.
        UnknownNameError: the recording has no such topic; the message lists them.
    """
    kind = path.suffix.lower()
    if kind not in (*_CSV, *_PARQUET) and (os.path.isdir(path) or kind in _BAGS):
        if clock is None:
            valid = "a topic whose messages set the rows (--clock), such as that of the commands"
            raise ParameterError("clock", clock, valid)
        bag = interop.read_bag(path, clock)
        return bag.names, partial(_bag_rows, path, bag)
    if not os.path.isfile(path):
        raise DescriptionError(path, "there is no such file")
    if kind not in (*_CSV, *_PARQUET):
        raise DescriptionError(path, f"files of kind '{path.suffix}' are not read; use .csv or .parquet")
    names, read = (open_csv if kind in _CSV else open_parquet)(path, label)
    if len(names) > _MOST_COLUMNS:
        raise DescriptionError(path, f"{len(names)} columns; at most {_MOST_COLUMNS} are read")
    names = names[1:] if names[:1] == ("",) else names
    for i, name in enumerate(names):
        if not name:
            raise DescriptionError(path, f"column {i + 1} has no name in the header")
        if name in names[:i]:
            raise DescriptionError(path, f"two columns are called '{name}'")
    return names, partial(_file_rows, names, read)


def open_parquet(path: Path, label: str) -> tuple[Names, Read]:
    """Column names, and a function that reads some of them; these hold numbers.

    Checksums of pages are compared where they were written (``write_page_checksum=True`` of pyarrow).

    Raises:
        DescriptionError: no Parquet file, damaged, or some kB that announce GB. The function raises it, too.
    """
    check_file(path, "file of a table", _LARGEST_PARQUET)
    parquet = require("pyarrow.parquet")
    with told_as_damage(path, "file, or no Parquet file"), parquet.ParquetFile(path) as file:
        return tuple(file.schema_arrow.names), partial(_parquet_columns, path, label)


def _parquet_columns(path: Path, label: str, columns: Sequence[str]) -> Array:
    parquet = require("pyarrow.parquet")
    with (
        told_as_damage(path, "Parquet file"),
        parquet.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        n = file.metadata.num_rows
        check_announced(path, 8 * n * (1 + len(columns)), path.stat().st_size)
        table = file.read(columns=list(columns))
        values = [_parquet_values(path, name, table.column(name), name == label) for name in columns]
        if any(len(column) != n for column in values):
            raise DescriptionError(path, "damaged: it has another number of rows than it says")
        return np.stack(values, -1) if columns else np.empty((n, 0))


def _parquet_values(path: Path, name: str, column: Any, is_label: bool) -> Array:
    types = require("pyarrow").types
    kind = column.type
    if is_label and (types.is_string(kind) or types.is_large_string(kind)):
        texts = column.to_pylist()
        number = labels(texts)
        found = np.array([number(text) if text else None for text in texts], dtype=np.float64)
    elif types.is_integer(kind) or types.is_floating(kind):
        found = column.to_numpy().astype(np.float64)
    else:
        raise DescriptionError(path, f"column '{name}' holds {kind}, not numbers; leave it out or encode it")
    if not np.isfinite(found).all():
        row = int(np.flatnonzero(~np.isfinite(found))[0])
        raise DescriptionError(path, f"row {row + 1}, column '{name}' is empty or not finite")
    return found


def _file_rows(names: Names, read: Read, wanted: Sequence[str]) -> Rows:
    """Another run begins where a column that is called time goes back."""
    values = read(wanted)
    starts, about = np.zeros(len(values), dtype=bool), ""
    for clock in filter(_TIME_WORD.fullmatch, names):
        try:
            column = read([clock])[:, 0]
        except DescriptionError:  # dates, or with holes
            continue
        step = np.diff(column, prepend=column[:1])
        back = step < 0
        again = np.abs(column[back] - column[:1]) <= np.median(np.abs(step)) if back.any() else back
        if 20 * back.sum() > len(back) and not again.all():
            if _TIME.fullmatch(clock):
                problem = f"goes back in {back.sum()} of {len(values)} rows, first in row {back.argmax() + 1}"
                about += f" Column '{clock}' {problem}: rows should be in the order of time."
        elif back.any() and (again.all() or 10 * back.sum() <= (step > 0).sum()):
            starts |= back
            about += f" {back.sum() + 1} runs: column '{clock}' goes back."
    return Rows(values, starts.cumsum(), about)


def _bag_rows(path: Path, bag: interop.BagTable, wanted: Sequence[str]) -> Rows:
    """The complete ones."""
    at = [bag.names.index(name) for name in wanted]
    values, n = bag.values[:, at], len(bag.time)
    missing = ~np.isfinite(values)
    kept = np.flatnonzero(~missing.any(axis=1))
    why: dict[tuple[str, str], list[str]] = {}  # columns of one topic mostly miss alike
    for name, gone in dict(zip(wanted, missing.T, strict=True)).items():
        if gone.any():
            why.setdefault((name.partition(".")[0], _gaps(gone, bag.time)), []).append(name)
    because = [
        (names[0] if len(names) == 1 else f"{topic} ({len(names)} columns, {names[0]})") + gaps
        for (topic, gaps), names in why.items()
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

    A single name stands for a list of one. Where the fields of a message have names, ``/topic.field[k]`` is
    the k-th of ``/topic.field.NAME``.

    Raises:
        UnknownNameError: there is no such column; the message lists the columns.
    """
    found: list[str] = []
    for pattern in [wanted] if isinstance(wanted, str) else wanted:
        begin = pattern.removesuffix("*")
        fits = [name for name in names if name == pattern or (begin != pattern and name.startswith(begin))]
        if not fits and (place := _INDEXED.fullmatch(pattern)):
            named = [name for name in names if name.startswith(f"{place[1]}.")]
            fits = named[int(place[2]) :][:1]
        if not fits:
            raise UnknownNameError("column", pattern, names)
        found += fits
    return list(dict.fromkeys(found))
