"""Tables as a picture: a dot for each figure, with its interval."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch_ekm.experiments.reporting.plots import COLOURS, new_figure
from torch_ekm.experiments.reporting.report import Table
from torch_ekm.experiments.reporting.statistics import Estimate

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Of columns; as in ``torch_ekm.experiments.learner_comparison``.
_SERIES = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9")


def dot_chart(
    tables: Sequence[Table], columns: Sequence[str], label: str, log: bool = False, shared: bool = True
) -> Figure:
    """A panel for each table, a line for each row with a figure, a dot for each of the columns.

    One column alone is blue where the name of its row is in bold, and grey elsewhere.

    Args:
        label: of the axis.
        shared: one axis for all panels.
    """
    heights = [len(table.rows) + 1.5 for table in tables]
    figure, panels = new_figure(7.0, 0.17 * sum(heights) + 0.8, 1, len(tables))
    panels[0].get_gridspec().set_height_ratios(heights)
    legend = {}
    for panel, table in zip(panels, tables, strict=True):
        for i, row in enumerate(table.rows):
            for k, column in enumerate(columns):
                value = row[table.header.index(column)]
                mean = value.mean if isinstance(value, Estimate) else value
                if not isinstance(mean, float) or math.isnan(mean):
                    continue
                ours = len(columns) > 1 or str(row[0]).startswith("**")
                colour, at = _SERIES[k] if ours else COLOURS["KM"], i + 0.16 * (k - (len(columns) - 1) / 2)
                (legend[column],) = panel.plot([mean], [at], "o", ms=4, color=colour)
                if isinstance(value, Estimate):
                    panel.plot([value.low, value.high], [at, at], color=colour, linewidth=1)
        panel.set_yticks(range(len(table.rows)), [str(row[0]).strip("*") for row in table.rows], fontsize=7)
        panel.set_ylim(len(table.rows) - 0.4, -0.6)
        panel.tick_params(axis="x", labelsize=7, labelbottom=not shared or panel is panels[-1])
        panel.set_title(table.caption, loc="left", fontsize=8)
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
