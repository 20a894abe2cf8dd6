"""What the command line prints: text of files as it stands, never as commands to the terminal."""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Iterator
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
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable
from rich.text import Text

if TYPE_CHECKING:
    from .experiments.reporting.report import Report

console = Console(markup=False)  # the units of a table are no styles, nor is "[red]" in a file
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


def say_error(text: object) -> None:
    """A line on the error stream."""
    line = Text.assemble(("torch-ekm:", "bold red"), " ", as_printed(text))
    Console(stderr=True).print(line, soft_wrap=True)


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[object], None]]:
    """What, a bar, how many of how many, and for how long; gives what is to be called after each."""
    name = TextColumn("{task.description}", markup=False)
    columns = (name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bars:
        task = bars.add_task(as_printed(what), total=total)
        yield lambda _: bars.advance(task)


def print_report(report: Report, folder: Path, notes: bool = False) -> None:
    """What came of it, the tables, and where the page is."""
    console.print(as_printed(report.summary))
    for table in report.tables:
        print_table(table.header, table.text(), table.caption, table.note if notes else None)
    say(f"Report:    {(folder / 'index.html').resolve()}")


def print_table(
    header: Iterable[str], rows: Iterable[Iterable[object]], title: str | None = None, note: str | None = None
) -> None:
    """Cells are text as it stands, and never cut short."""
    table = RichTable(*map(as_printed, header))
    table.title, table.caption = (text and as_printed(text) for text in (title, note))
    for row in rows:
        table.add_row(*map(as_printed, row))
    for column in table.columns:
        column.overflow = "fold"  # figures are never cut short
    # a file or a pipe has no width of its own
    (console if console.is_terminal else Console(width=1000, markup=False)).print(table)
