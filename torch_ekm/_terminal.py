"""What the command line prints: text of files as it stands, never as commands to the terminal."""

from __future__ import annotations

import re
import textwrap
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from ._extras import require
from .exceptions import MissingExtraError

try:
    require("typer")
    require("rich")
except MissingExtraError as error:
    raise SystemExit(f"torch-ekm: {error}") from None

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table as RichTable
from rich.text import Text

if TYPE_CHECKING:
    from .experiments.reporting.report import Report

console = Console(markup=False)  # the units of a table are no styles, nor is "[red]" in a file
_PIPED = 120  # characters of a line in a file or a pipe, which has no width of its own
_SHORT = 34  # characters: what is longer is prose, which may be wrapped
_FIGURE = re.compile(r"[-+]?\d[\d.e+-]*(?: \[[^\]]*\])?(?: (?:%|deg\b|mm\b))?")
# control characters, formats such as a change of the direction of writing, halves of characters
_UNPRINTED = ("Cc", "Cf", "Cs", "Zl", "Zp")


def as_printed(text: object) -> str:
    """``text`` with every character that a terminal would obey as its escape: ESC as ``\\x1b``.

    Line breaks stay.
    """
    return "".join(
        c if c == "\n" or unicodedata.category(c) not in _UNPRINTED else repr(c)[1:-1] for c in str(text)
    )


def say(text: object) -> None:
    """A line, which the terminal does not wrap: paths can be copied."""
    console.print(as_printed(text), soft_wrap=True, highlight=False)


def say_next(text: object) -> None:
    """What to do after a command."""
    say(f"Next:      {text}")


def say_error(text: object) -> None:
    """Print a line on the error stream, headed by the program's name."""
    line = Text.assemble(("torch-ekm:", "bold red"), " ", as_printed(text))
    Console(stderr=True).print(line, soft_wrap=True)


def say_note(text: object) -> None:
    """A remark, on the error stream."""
    Console(stderr=True, markup=False).print(
        f"Note:      {as_printed(text)}", soft_wrap=True, highlight=False
    )


@contextmanager
def progress(what: str, total: int, seconds: float = 0.0) -> Iterator[Callable[[object], None]]:
    """What, a bar, how many of how many, for how long, how long still; gives what is called after each.

    Ctrl-C ends it; what is finished is kept by who runs it.

    Args:
        seconds: what all take on free cores: an estimate, until the first has ended; 0: unknown.
    """
    minutes = max(round(seconds / 60), 1)
    about = f"{total} to do, some {minutes} min on free cores, less what is finished. " if seconds else ""
    say(f"{about}Ctrl-C stops; the same command then goes on from there.")
    name = TextColumn("{task.description}", markup=False)
    left = TextColumn("left:"), TimeRemainingColumn()
    columns = (name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), *left)
    with Progress(*columns, console=console) as bars:
        task = bars.add_task(as_printed(what), total=total)
        try:
            yield lambda _: bars.advance(task)
        except KeyboardInterrupt:
            bars.stop()
            say("Stopped. The same command goes on from here.")
            raise


def unbroken(text: str, width: int) -> str:
    """Lines of at most this width, with figures, their intervals and units on one."""
    kept = _FIGURE.sub(lambda found: found[0].replace(" ", "\u00a0"), text)
    return textwrap.fill(kept, width, break_long_words=False, break_on_hyphens=False).replace("\u00a0", " ")


def print_report(report: Report, folder: Path, notes: bool = False, every: bool = False) -> None:
    """What came of it, the leading tables or every one, and where the page is, which has all."""
    say(unbroken(as_printed(report.summary), console.width))
    for table in report.tables if every else report.tables[: max(report.leading, 1)]:
        print_table(table.header, table.text(), table.caption, table.note if notes else None)
    if report.figures:
        say(f"Figures:   {', '.join(figure.path for figure in report.figures)}")
    say(f"Report:    {(folder / 'index.html').resolve()}")


def print_table(
    header: Iterable[str], rows: Iterable[Iterable[object]], title: str | None = None, note: str | None = None
) -> None:
    """Cells are text as it stands, never cut short; figures with their intervals are not broken over lines.

    A table that is too wide for the terminal is printed in parts, each with the first column.
    """
    head, cells = [*map(as_printed, header)], [[*map(as_printed, row)] for row in rows]
    screen = console if console.is_terminal else Console(width=_PIPED, markup=False)
    parts = _parts([_width(column) for column in zip(head, *cells, strict=True)], screen.width)
    for number, columns in enumerate(parts):
        table = RichTable(title=as_printed(title) if title and not number else None)
        for column in columns:
            figures = all(len(row[column]) <= _SHORT for row in cells)
            table.add_column(head[column], overflow="fold", no_wrap=figures and len(head[column]) <= _SHORT)
        for row in cells:
            table.add_row(*(row[column] for column in columns))
        screen.print(table)
    if note:
        screen.print(unbroken(as_printed(note), screen.width), highlight=False)


def _width(column: Sequence[str]) -> int:
    """Of a column with its borders, where prose may be wrapped."""
    return min(max(map(len, column)), _SHORT) + 3


def _parts(widths: Sequence[int], screen: int) -> list[list[int]]:
    """Columns of each part of a table: the first, and as many others as there is room for, one at least."""
    parts, room = [[0]], screen - widths[0] - 1
    for column, width in enumerate(widths[1:], start=1):
        if width > room and len(parts[-1]) > 1:
            parts.append([0])
            room = screen - widths[0] - 1
        parts[-1].append(column)
        room -= width
    return parts
