"""Columns of a CSV file, whoever wrote it: Excel, pandas, numpy, a logger in C."""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..._files import decode, figure, read_file
from ...exceptions import DescriptionError
from ...typing import Array

Names = tuple[str, ...]
#: Values ``(n_rows, n)`` of the n columns that it is given.
Read = Callable[[Sequence[str]], Array]

_LARGEST = 128 << 20  # bytes: a figure of one digit takes four times as much in memory
_LONGEST = 1 << 20  # characters of one record, which is a line where no quoted text has line breaks
_SEPARATORS = ",;\t "
_EXCEL = re.compile(r'"?sep=([,;\t|:^~])"?', re.IGNORECASE)
_TRIED, _LINES = 6, 1000  # records that decide on the separator, and lines in which they are looked for


class _Table(NamedTuple):
    """A text, as one separator parts it."""

    path: Path
    text: str
    before: int
    """Lines before the header."""
    separator: str

    def records(self, most: int | None = None) -> Iterator[tuple[int, list[str]]]:
        """Those of all or of ``most`` lines that are not blank, with the number of their last line; the first
        may be a comment."""
        length = number = 0

        def lines() -> Iterator[str]:  # knows nothing of the reader: a circle would keep the text in memory
            nonlocal length, number
            end = None if most is None else self.before + most
            wanted = itertools.islice(io.StringIO(self.text, newline=""), self.before, end)
            for number, line in enumerate(wanted, self.before + 1):
                length += len(line)
                if length > _LONGEST:
                    problem = f"has more than {_LONGEST} characters, or stands in a quote that does not close"
                    raise DescriptionError(self.path, f"line {number} {problem}")
                yield line.lstrip(" " if number > self.before + 1 else "# ")

        try:
            for row in csv.reader(lines(), delimiter=self.separator, skipinitialspace=True):
                length = 0
                if len(row) > 1 or (row and row[0].strip()):
                    yield number, [field.strip() for field in row]
        except csv.Error as error:
            raise DescriptionError(self.path, f"line {number}: {error}") from None


def open_csv(path: Path, label: str) -> tuple[Names, Read]:
    """Column names, and a function that reads some of them.

    UTF-8, of at most 128 MiB. Separated by comma, semicolon, tab or blanks: by the one that gives the first
    lines as many fields as the header, texts in quotes apart; or as a first line ``sep=;`` says. The header
    names the columns. Lines before it may be comments, ``# ...``; the last of them is the header where only
    numbers follow, as of ``numpy.savetxt``. Every other field that is read is a number with a decimal point.
    Blanks around fields, empty lines, and a separator at the end of a line do not count.

    Raises:
        DescriptionError: the file cannot be used; the message names line and column. The function raises
            it, too.
    """
    text = decode(read_file(path, "file of a table", _LARGEST), path)
    if not text or text.isspace():
        raise DescriptionError(path, "the file is empty")
    before, given = _preamble(text)
    table = max((_Table(path, text, before, one) for one in given or _SEPARATORS), key=_fit)
    number, names = next(table.records(), (0, []))
    names = _trimmed(names, n := len(names) - 1)
    if all(figure(field) is not None for field in names):
        table = table._replace(before=before - 1)
        names = _trimmed(next(table.records())[1], n) if before else []
        if len(names) <= n or all(figure(field) is not None for field in names):
            problem = "holds numbers only; it, or a comment right before it, must name the columns"
            raise DescriptionError(path, f"line {number} {problem}")
    return tuple(names), partial(_read, table, tuple(names), label)


def _fit(table: _Table) -> tuple[bool, int]:
    """How well a separator does: whether the first lines have as many fields as the header, and how many."""
    try:
        first = [row for _, row in itertools.islice(table.records(_LINES), _TRIED)]
    except DescriptionError:
        return False, 1
    names = _trimmed(first[0], len(first[0]) - 1) if first else []
    fits = all(len(_trimmed(row, len(names))) == len(names) > 1 for row in first)
    return fits, 1 if table.separator == " " and not fits else len(names)  # names may hold blanks


def _preamble(text: str) -> tuple[int, str]:
    """Lines before the header, and the separator that they say."""
    separator = ""
    for number, line in enumerate(io.StringIO(text, newline="")):
        line = line.strip("\r\n")
        stated = _EXCEL.fullmatch(line)
        if stated is None and line.strip() and not line.startswith("#"):
            return number, separator
        separator = stated[1] if stated else separator
    return 0, separator


def _trimmed(row: list[str], n: int) -> list[str]:
    """Without what an n + 1st separator at the end of a line makes."""
    return row[:n] if n > 0 and len(row) == n + 1 and not row[-1] else row


def _read(table: _Table, names: Names, label: str, columns: Sequence[str]) -> Array:
    rows = partial(_rows, table, len(names))
    places = [names.index(name) for name in columns]
    numbers: list[Callable[[str], float | None]] = [figure] * len(columns)
    if label in columns:
        at = columns.index(label)
        numbers[at] = labels(row[places[at]] for _, row in rows())
    taken, n, bad, first = array("d"), 0, 0, ""
    for line, row in rows():
        values = [number(row[place]) for number, place in zip(numbers, places, strict=True)]
        wrong = [j for j, value in enumerate(values) if value is None or not math.isfinite(value)]
        if wrong:
            bad += 1
            first = first or f"line {line}, column '{columns[wrong[0]]}'{_problem(row[places[wrong[0]]])}"
        else:
            taken.extend(values)  # pyright: ignore[reportArgumentType]
        n += 1
    if bad:
        more = f". {bad} of {n} lines have a field that is no finite number" if bad > 1 else ""
        raise DescriptionError(table.path, first + more)
    return np.array(taken).reshape(n, len(places))


def _rows(table: _Table, n: int) -> Iterator[tuple[int, list[str]]]:
    for line, row in itertools.islice(table.records(), 1, None):
        row = _trimmed(row, n)
        if len(row) != n:
            problem = f"has {len(row)} fields, but the header names {n} columns"
            raise DescriptionError(table.path, f"line {line} {problem}")
        yield line, row


def labels(texts: Iterable[str | None]) -> Callable[[str], float | None]:
    """The number of a text: that which it is, if all are numbers; else each has one of its own."""
    found = list(dict.fromkeys(filter(None, texts)))
    if all(figure(text) is not None for text in found):
        return figure
    return {text: float(number) for number, text in enumerate(found)}.get


def _problem(field: str) -> str:
    if not field:
        return " is empty; fill it in, or leave the whole line out"
    if "," in field and figure(field.replace(",", ".", 1)) is not None:
        return f": '{field}' has a decimal comma; write a point"
    if figure(field) is None:
        return f": '{field}' is no number; encode it, or leave the column or the line out"
    return f": '{field}' is not finite; fill it in, or leave the whole line out"
