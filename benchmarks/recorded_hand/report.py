"""The benchmark as a page: a table for each horizon."""

from __future__ import annotations

from pathlib import Path

from dots import dot_chart

from torch_ekm.experiments.reporting.plots import save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table

from .benchmark import HORIZONS, RecordedHandResult
from .recordings import APART, STEP
from .scores import COORDINATES


def write_report(result: RecordedHandResult, folder: str | Path) -> Report:
    """Tables as CSV, a figure, and ``index.html`` with all of them, into ``folder``."""
    horizons = sorted(HORIZONS, reverse=True)
    tables = [score_table(result, horizon) for horizon in horizons]
    caption = (
        "Error of the position over its motion, and 95 % intervals over objects; 1: as if nothing moved."
    )
    dots = save_figure(dot_chart(tables[:1], ["x", "y"], "error / motion"), Path(folder), "scores", caption)
    configuration = {"apart": APART, "objects": result.reported, "calibration": str(result.calibration)}
    title = "Recorded motions of a Yale T42, predicted"
    report = Report(title, summary(result), tables, [dots], configuration=configuration)
    report.write(Path(folder))
    return report


def summary(result: RecordedHandResult) -> str:
    """The main figures in a few sentences."""
    said = [
        f"{len(result.reported)} objects on which nothing was identified; error over motion, "
        f"{HORIZONS[-1] * STEP:g} s ahead."
    ]
    for row in result.rows:
        if row.horizon == HORIZONS[-1] and "no model" not in row.name:
            said.append(f"{row.name}: x {row.ratio['x'].mean:.2f}, y {row.ratio['y'].mean:.2f}.")
    return " ".join(said)


def score_table(result: RecordedHandResult, horizon: int) -> Table:
    """Every way to predict at one horizon."""
    rows = [row for row in result.rows if row.horizon == horizon and row.name != "no model"]
    cells: list[list[Cell]] = [[row.name, *(row.ratio[c] for c in COORDINATES), row.rms] for row in rows]
    columns = ["prediction", *(Column(c, ".3f") for c in COORDINATES), Column("rms", ".3f")]
    note = (
        "rms error over rms motion, both cut at their 99 % quantile, 95 % interval over objects; 1: as if "
        "nothing moved. Last: of all three coordinates in units of their spread, not cut, mean over objects."
    )
    caption = f"{horizon * STEP:g} s ahead"
    return Table(f"scores_{horizon}", caption, columns, cells, note)
