"""Tables of a page as a picture: a dot for each figure, with its interval."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch_ekm.experiments.reporting.plots import COLOURS, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FIGURE = re.compile(r"(-?\d+(?:\.\d+)?)(?: \[(-?[\d.]+), (-?[\d.]+)\])?")
#: Of columns that are no controllers; as in ``torch_ekm.experiments.learner_comparison``.
_OTHERS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")
Rows = list[dict[str, str]]


def tables_with(body: str, columns: Sequence[str], captions: str = "") -> dict[str, Rows]:
    """Caption -> rows that have a figure, of the Markdown tables with one of these columns."""
    found: dict[str, Rows] = {}
    caption = ""
    for block in re.split(r"\n{2,}", body):
        if block.startswith("### "):
            caption = block.removeprefix("### ")
        if block.startswith("|") and caption.startswith(captions):
            head, _, *cells = (
                [cell.strip() for cell in line.split("|")[1:-1]] for line in block.splitlines()
            )
            rows = [dict(zip(["", *head[1:]], row, strict=True)) for row in cells]
            if rows := [row for row in rows if any(_FIGURE.match(row.get(one, "")) for one in columns)]:
                found[caption] = rows
    return found


def dot_chart(
    body: str,
    columns: Sequence[str],
    label: str,
    captions: str = "",
    log: bool = False,
    shared: bool = True,
) -> Figure:
    """A panel for each table, a line for each row, a dot for each of the columns.

    Args:
        body: Markdown; the first column of a table has the names of its rows.
        label: of the axis.
        captions: how the captions of the tables begin.
        shared: one axis for all panels.
    """
    tables = tables_with(body, columns, captions)
    heights = [len(rows) + 1.5 for rows in tables.values()]
    figure, panels = new_figure(7.0, 0.17 * sum(heights) + 0.8, 1, len(tables))
    panels[0].get_gridspec().set_height_ratios(heights)
    legend = {}
    for panel, (caption, rows) in zip(panels, tables.items(), strict=True):
        for i, row in enumerate(rows):
            for k, column in enumerate(columns):
                if not (one := _FIGURE.match(row.get(column, ""))):
                    continue
                value, *interval = (None if text is None else float(text) for text in one.groups())
                name = column.split(" [")[0] if len(columns) > 1 else row[""]
                colour = _colour(name, k, len(columns) > 1)
                at = i + 0.16 * (k - (len(columns) - 1) / 2)
                (legend[name],) = panel.plot([value], [at], "o", ms=4, color=colour)
                if None not in interval:
                    panel.plot(interval, [at, at], color=colour, linewidth=1)
        panel.set_yticks(range(len(rows)), [row[""].strip("*") for row in rows], fontsize=7)
        panel.set_ylim(len(rows) - 0.4, -0.6)
        panel.tick_params(axis="x", labelsize=7, labelbottom=not shared or panel is panels[-1])
        panel.set_title(caption, loc="left", fontsize=8)
        if log:
            panel.set_xscale("log")
    if shared:
        low, high = (pick(panel.get_xlim()[side] for panel in panels) for side, pick in enumerate((min, max)))
        for panel in panels:
            panel.set_xlim(low, high)
    panels[-1].set_xlabel(label)
    if len(columns) > 1:
        figure.legend([*legend.values()], [*legend], loc="outside upper right", ncols=len(legend), fontsize=7)
    return figure


def _colour(name: str, k: int, series: bool) -> str:
    """Of a controller its own; of other columns by their number; of rows blue for ours, which are in bold."""
    known = COLOURS.get(re.split("[, ]", name)[0])
    return known or (_OTHERS[k % len(_OTHERS)] if series or name.startswith("**") else COLOURS["KM"])
