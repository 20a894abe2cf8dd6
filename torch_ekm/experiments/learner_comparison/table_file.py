"""A table of numbers from a file; whatever is wrong is named with its line and column."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ... import interop
from ...exceptions import DescriptionError, ParameterError, UnknownNameError
from .csv_file import Names, Read, open_csv
from .parquet_file import open_parquet

_BAGS = (".mcap", ".db3", ".bag")
_READERS = {
    ".csv": open_csv, ".tsv": open_csv, ".txt": open_csv, ".parquet": open_parquet, ".pq": open_parquet
}  # fmt: skip
_MOST_COLUMNS = 4096
_INDEXED = re.compile(r"(.+)\[([0-9]{1,4})\]")


def open_table(path: Path, clock: str | None = None, label: str = "") -> tuple[Names, Read]:
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
    if kind not in _READERS and (path.is_dir() or kind in _BAGS):
        if clock is None:
            raise ParameterError(
                "clock", clock, "a topic whose messages set the rows, such as that of the commands"
            )
        heard, _, values = interop.read_bag(path, clock)
        return heard, lambda wanted: values[:, [heard.index(name) for name in wanted]]
    if not path.is_file():
        raise DescriptionError(path, "there is no such file")
    if kind not in _READERS:
        raise DescriptionError(path, f"files of kind '{path.suffix}' are not read; use .csv or .parquet")
    names, read = _READERS[kind](path, label)
    if len(names) > _MOST_COLUMNS:
        raise DescriptionError(path, f"{len(names)} columns; at most {_MOST_COLUMNS} are read")
    names = names[1:] if names[:1] == ("",) else names
    known: set[str] = set()
    for i, name in enumerate(names):
        if not name:
            raise DescriptionError(path, f"column {i + 1} has no name in the header")
        if name in known:
            raise DescriptionError(path, f"two columns are called '{name}'")
        known.add(name)
    return names, read


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
