"""The benchmark as a page: a table for each horizon, and predicted paths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from dots import dot_chart

from torch_ekm.experiments.reporting.plots import new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table

from .benchmark import HORIZONS, RecordedHandResult
from .recordings import APART, STEP
from .scores import COORDINATES, SUBSETS

_COLOURS = {
    "constant Jacobian, play": "#E69F00", "KM, published figures, play": "#009E73",
    "KM, calibrated, play": "#0072B2", "KM, figures online, play": "#CC79A7",
}  # fmt: skip
_PICTURED = ("cyl35_red_d_v0", "sqr30_d_v0", "egg50_d_v0")


def write_report(result: RecordedHandResult, folder: str | Path) -> Report:
    """Tables as CSV, a figure, and ``index.html`` with all of them, into ``folder``."""
    names = [name for name in _PICTURED if name in result.paths] or result.reported[:3]
    caption = "Recorded paths (grey) and each model's prediction of the object after five seconds."
    figure = save_figure(plot_paths(result, names), Path(folder), "paths", caption)
    horizons = sorted(HORIZONS, reverse=True)
    tables = [score_table(result, horizon, subset) for subset in SUBSETS for horizon in horizons]
    caption = (
        "Error of the position over its motion, and 95 % intervals over objects; 1: as if nothing moved."
    )
    dots = save_figure(dot_chart(tables[:1], ["x", "y"], "error / motion"), Path(folder), "scores", caption)
    configuration = {"apart": APART, "objects": result.reported, "calibration": str(result.calibration)}
    title = "Recorded motions of a Yale T42, predicted"
    report = Report(title, summary(result), tables, [dots, figure], configuration=configuration)
    report.write(Path(folder))
    return report


def summary(result: RecordedHandResult) -> str:
    """The main figures in a few sentences."""
    said = [
        f"{len(result.reported)} objects on which nothing was identified; error over motion, "
        f"{HORIZONS[-1] * STEP:g} s ahead."
    ]
    for row in result.rows:
        if (row.horizon, row.subset) == (HORIZONS[-1], "all") and "no model" not in row.name:
            said.append(f"{row.name}: x {row.ratio['x'].mean:.2f}, y {row.ratio['y'].mean:.2f}.")
    return " ".join(said)


def score_table(result: RecordedHandResult, horizon: int, subset: str) -> Table:
    """Every way to predict at one horizon, on some of the samples."""
    rows = [row for row in result.rows if (row.horizon, row.subset) == (horizon, subset)]
    cells: list[list[Cell]] = [[row.name, *(row.ratio[c] for c in COORDINATES), row.rms] for row in rows]
    columns = ["prediction", *(Column(c, ".3f") for c in COORDINATES), Column("rms", ".3f")]
    note = (
        "rms error over rms motion, both cut at their 99 % quantile, 95 % interval over objects; 1: as if "
        "nothing moved. Last: of all three coordinates in units of their spread, not cut, mean over objects."
    )
    caption = f"{horizon * STEP:g} s ahead: {SUBSETS[subset]}"
    return Table(f"scores_{horizon}_{subset}", caption, columns, cells, note)


def plot_paths(result: RecordedHandResult, names: list[str]) -> Any:
    """Longest path of each object, and the predicted motion from every fifth second on."""
    horizon = HORIZONS[-1]
    figure, axes = new_figure(4.2 * len(names), 4.0, columns=len(names))
    for axis, name in zip(axes, names, strict=True):
        taken = result.samples[horizon][name]
        number = int(np.argmax([len(path) for path in result.paths[name]]))
        pose, own = result.paths[name][number].pose, taken.path == number
        starts = result.states[name].step[taken.row[own]]
        axis.plot(*(1e3 * pose[:, :2]).T, color="0.75", linewidth=3, label="recorded", zorder=1)
        for label, colour in _COLOURS.items():
            step = result.predicted[label, horizon][name][own, :2]
            for k, start in enumerate(starts):
                line = 1e3 * np.array([pose[start, :2], pose[start, :2] + step[k]])
                axis.plot(*line.T, color=colour, linewidth=1.3, label=label if k == 0 else None, zorder=2)
        axis.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
        axis.set_title(name.removesuffix("_d_v0"), loc="left", fontsize=10)
    axes[0].legend(frameon=False, fontsize=7)
    return figure
