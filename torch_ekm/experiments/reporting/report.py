"""A report folder: one page, its tables as CSV, its figures, and how it was made."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..._extras import require
from ..._versions import versions_of

_PACKAGES = (
    "torch_ekm",
    "torch",
    "numpy",
    "scipy",
    "sapien",
    "coal",
    "qpsolvers",
    "piqp",
    "pytorch-kinematics",
)


@dataclass(frozen=True)
class Table:
    """A table of strings, ready to be read."""

    name: str
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""


@dataclass(frozen=True)
class FigureFile:
    """A figure that lies in the report's folder."""

    path: str
    caption: str


@dataclass
class Report:
    """What a run has to show.

    ``write`` leaves ``index.html``, one CSV for each table, and ``configuration.json`` with the exact
    configuration, versions and seeds.
    """

    title: str
    summary: str
    tables: list[Table] = field(default_factory=list)
    figures: list[FigureFile] = field(default_factory=list)
    configuration: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write everything into ``folder`` and return the page's path."""
        folder.mkdir(parents=True, exist_ok=True)
        configuration = json.dumps({**self.configuration, "versions": versions()}, indent=2, sort_keys=True)
        (folder / "configuration.json").write_text(configuration + "\n", encoding="utf-8")
        for table in self.tables:
            with (folder / f"{table.name}.csv").open("w", newline="", encoding="utf-8") as stream:
                writer = csv.writer(stream)
                writer.writerow(table.header)
                writer.writerows(table.rows)
        jinja2 = require("jinja2")
        template = jinja2.Environment(autoescape=True).from_string(
            (Path(__file__).parent / "templates" / "report.html").read_text(encoding="utf-8")
        )
        page = folder / "index.html"
        page.write_text(
            template.render(
                title=self.title,
                summary=self.summary,
                tables=self.tables,
                figures=self.figures,
                configuration=configuration,
            ),
            encoding="utf-8",
        )
        return page


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that decide the numbers."""
    return versions_of(_PACKAGES)
