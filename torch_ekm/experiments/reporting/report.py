"""A report folder: one page, its tables as CSV, its figures, and how it was made."""

from __future__ import annotations

import csv
import html
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from ..._extras import require, versions_of
from ..._files import make_folder, told_as_output_error
from .statistics import Estimate

_PACKAGES = (
    "torch_ekm", "torch", "numpy", "scipy", "sapien", "coal", "qpsolvers", "piqp", "pytorch-kinematics",
)  # fmt: skip
T = TypeVar("T")
#: None: there is nothing to say.
Cell = str | bool | int | float | Estimate | None


@dataclass(frozen=True)
class Column:
    """A heading, and how the figures below it are written."""

    name: str
    spec: str = ".2f"
    """It formats real numbers and estimates, as in ``format(x, spec)``."""
    percent: bool = False
    """The cells are shares, written in percent."""

    def text(self, cell: Cell) -> str:
        """A cell of this column as it is written."""
        if cell is None or (isinstance(cell, float) and math.isnan(cell)):
            return "-"
        if isinstance(cell, bool):
            return "yes" if cell else "no"
        if isinstance(cell, float | Estimate):
            return format(100 * cell if self.percent else cell, self.spec)
        return str(cell)


@dataclass(frozen=True, repr=False)
class Table:
    """Numbers with their intervals, formatted when they are written."""

    name: str
    caption: str
    columns: Sequence[Column | str]
    """A text stands for a column in the usual format."""
    rows: Sequence[Sequence[Cell]]
    note: str = ""

    @classmethod
    def of(
        cls,
        name: str,
        caption: str,
        label: str,
        items: Mapping[str, T],
        columns: Mapping[Column, Callable[[T], Cell]],
        note: str = "",
    ) -> Table:
        """A row for each item; every column is a function of it, after a first one with its key.

        Args:
            label: heading of the first column.
        """
        rows = [[key, *(value(item) for value in columns.values())] for key, item in items.items()]
        return cls(name, caption, [label, *columns], rows, note)

    @property
    def header(self) -> list[str]:
        """Names of the columns, from left to right."""
        return [column.name for column in self._columns]

    def text(self) -> list[list[str]]:
        """All cells as they are written, row by row."""
        rows = (zip(self._columns, row, strict=True) for row in self.rows)
        return [[column.text(cell) for column, cell in row] for row in rows]

    def __repr__(self) -> str:
        rows = [self.header, *self.text()]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join([self.caption, *lines, self.note])

    def _repr_html_(self) -> str:
        """As the last line of a notebook cell."""
        head = "".join(f"<th>{html.escape(name)}</th>" for name in self.header)
        body = ("".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in self.text())
        rows = "".join(f"<tr>{cells}</tr>" for cells in body)
        return (
            f"<p><b>{html.escape(self.caption)}</b></p><table><thead><tr>{head}</tr></thead>"
            f"<tbody>{rows}</tbody></table><p><i>{html.escape(self.note)}</i></p>"
        )

    @property
    def _columns(self) -> list[Column]:
        return [Column(column) if isinstance(column, str) else column for column in self.columns]


@dataclass(frozen=True)
class FigureFile:
    """A figure that lies in the report's folder."""

    path: str
    caption: str


@dataclass
class Report:
    """A report shows what came of a run.

    ``write`` leaves ``index.html``, the same as ``report.md``, one CSV for each table, and
    ``configuration.json`` with the exact configuration, versions and seeds. On the page the answer comes
    first, then the leading tables, the figures, and the other tables, folded.
    """

    title: str
    summary: str
    """The answer, with its intervals."""
    tables: list[Table] = field(default_factory=list)
    figures: list[FigureFile] = field(default_factory=list)
    configuration: dict[str, Any] = field(default_factory=dict)
    leading: int = 1
    """So many of the first tables are not folded."""
    legend: Mapping[str, str] = field(default_factory=dict)
    """A line for each name that is compared."""
    empty: bool = False
    """Nothing was measured: the summary says why, and a command ends with 1."""

    def write(self, folder: Path) -> Path:
        """Write everything into ``folder`` and return the page's path; equal reports give equal files.

        Raises:
            OutputError: the folder cannot be written to.
        """
        make_folder(folder)
        configuration = json.dumps({**self.configuration, "versions": versions()}, indent=2, sort_keys=True)
        with told_as_output_error(folder):
            (folder / "configuration.json").write_text(configuration + "\n", encoding="utf-8")
            for table in self.tables:
                with (folder / f"{table.name}.csv").open("w", newline="", encoding="utf-8") as stream:
                    csv.writer(stream).writerows([table.header, *table.text()])
            (folder / "report.md").write_text(self.markdown(), encoding="utf-8")
            page = folder / "index.html"
            page.write_text(self._render("html", configuration=configuration), encoding="utf-8")
            return page

    def markdown(self, level: int = 1) -> str:
        """The page as Markdown.

        Args:
            level: of its heading; below 1 the heading itself is left out, for a page that has one.
        """
        return self._render("md", level=level)

    def _render(self, kind: str, **given: Any) -> str:
        environment = require("jinja2").Environment(autoescape=kind == "html", keep_trailing_newline=True)
        template = (Path(__file__).parent / "templates" / f"report.{kind}").read_text(encoding="utf-8")
        return environment.from_string(template).render({**vars(self), **given})


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide the numbers."""
    return versions_of(_PACKAGES)
