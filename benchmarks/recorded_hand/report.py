"""What is scored, and the benchmark as a page: errors over motions, with intervals over objects."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from dots import dot_chart

from torch_ekm.experiments.learner_comparison.scores import block_bootstrap
from torch_ekm.experiments.reporting.plots import save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.reporting.statistics import Estimate
from torch_ekm.typing import Array

from .nominal import Samples
from .recordings import APART, STEP

if TYPE_CHECKING:
    from .benchmark import RecordedHandResult

COORDINATES = ("x", "y", "angle")
_CUT = 0.99  # quantile of each coordinate at which errors and motions are cut: an object that drops


class Row(NamedTuple):
    """One way to predict, at one horizon."""

    name: str
    horizon: int
    """[steps of 0.1 s]"""
    ratio: dict[str, Estimate]
    """Of each coordinate: rms error over rms motion, cut; 1: as if nothing moved."""
    rms: float
    """rms error of all coordinates in units of their spread, over that of the motion: mean over objects."""


def score(
    name: str,
    horizon: int,
    samples: Mapping[str, Samples],
    predicted: Mapping[str, Array],
    unit: Array,
) -> Row:
    """One row of the table.

    Args:
        samples: of the objects that are reported.
        predicted: of the same objects.
        unit: spread of the motion of the recording set apart ``(3,)``.
    """
    motion = {key: taken.motion for key, taken in samples.items()}
    error = {key: motion[key] - predicted[key] for key in samples}
    blocks = np.repeat(np.arange(len(samples)), [len(part) for part in motion.values()])
    wrong, moved = (_cut(np.concatenate(list(parts.values()))) ** 2 for parts in (error, motion))
    ratio = {c: block_bootstrap(wrong[:, k], moved[:, k], blocks) for k, c in enumerate(COORDINATES)}
    rms = [
        np.sqrt(np.mean((error[key] / unit) ** 2) / np.mean((motion[key] / unit) ** 2))
        for key in samples
        if len(motion[key])
    ]
    return Row(name, horizon, ratio, float(np.mean(rms)))


def _cut(values: Array) -> Array:
    size = np.abs(values)
    return np.minimum(size, np.quantile(size, _CUT, axis=0)) if len(size) else size


def write_report(result: RecordedHandResult, folder: str | Path) -> Report:
    """Tables as CSV, a figure, and ``index.html`` with all of them, into ``folder``."""
    tables = [score_table(result, horizon) for horizon in sorted(result.samples, reverse=True)]
    caption = (
        "Error of the position over its motion, and 95 % intervals over objects; 1: as if nothing moved."
    )
    dots = save_figure(dot_chart(tables[:1], ["x", "y"], "error / motion"), Path(folder), "scores", caption)
    configuration = {"apart": APART, "objects": result.reported}
    title = "Recorded motions of a Yale T42, predicted"
    report = Report(title, summary(result), tables, [dots], configuration=configuration)
    report.write(Path(folder))
    return report


def summary(result: RecordedHandResult) -> str:
    """The main figures in a few sentences."""
    longest = max(result.samples)
    said = [
        f"{len(result.reported)} objects on which nothing was identified; error over motion, "
        f"{longest * STEP:g} s ahead."
    ]
    for row in result.rows:
        if row.horizon == longest and "no model" not in row.name:
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
