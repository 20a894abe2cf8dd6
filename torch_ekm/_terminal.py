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


def print_report(report: Report, folder: Path, notes: bool = False, every: bool = False) -> None:
    """What came of it, the leading tables or every one, and where the page is, which has all."""
    console.print(as_printed(report.summary), highlight=False)
    for table in report.tables if every else report.tables[: max(report.leading, 1)]:
        print_table(table.header, table.text(), table.caption, table.note if notes else None)
    if report.figures:
        say(f"Figures:   {', '.join(figure.path for figure in report.figures)}")
    say(f"Report:    {(folder / 'index.html').resolve()}")


def print_table(
    header: Iterable[str], rows: Iterable[Iterable[object]], title: str | None = None, note: str | None = None
) -> None:
    """Cells are text as it stands, broken into lines where the terminal is narrow, never cut short."""
    screen = console if console.is_terminal else Console(width=_PIPED, markup=False)
    table = RichTable(title=as_printed(title) if title else None)
    for name in header:
        table.add_column(as_printed(name), overflow="fold")
    for row in rows:
        table.add_row(*map(as_printed, row))
    screen.print(table)
    if note:
        screen.print(as_printed(note), highlight=False)
