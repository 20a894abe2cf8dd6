"""A comparison of learners as tables, as text and as a report folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ..reporting.plots import save_figure
from ..reporting.report import Cell, Column, Report, Table
from .plots import plot_learning_curves, plot_scores
from .scores import Comparison, Score


class ComparisonReport(Comparison):
    """A comparison that prints as a table and can be written."""

    def tables(self) -> list[Table]:
        """One for each stream, and one of its outputs in the units of the file; of several streams an
        overview first."""
        tables = [score_table(self, stream.name) for stream in self.streams]
        units = [output_table(self, stream.name) for stream in self.streams if stream.outputs]
        overview = [overview_table(self)] if len(tables) > 1 else []
        return [*overview, *tables, *units]

    def __str__(self) -> str:
        return "\n".join([str(self.tables()[0]), *self.verdicts()])

    def write(self, folder: str | Path) -> Report:
        """Tables as CSV, figures as SVG and PNG, and ``index.html`` with all of them, into ``folder``."""
        save = partial(save_figure, folder=Path(folder))
        caption = (
            "Error over that of the model alone with 95 % intervals, left of 1 a learner helps. Blue: "
            "the default learner and sparse online GPs; filled: the best of each stream."
        )
        figures = [save(plot_scores(self), name="scores", caption=caption)]
        for stream in (s.name for s in self.streams):
            shown, n = curve_learners(self, stream), len(self.learners)
            some = f": {len(shown)} of {n} learners" if len(shown) < n else ""
            caption = f"The {self.measure(stream)} error on {stream} over time, each sample predicted "
            caption += f"before it is learned{some}."
            figure = plot_learning_curves(self, stream, shown)
            figures.append(save(figure, name=f"curve_{stream}", caption=caption))
        rows = {s.name: {"samples": len(s), "available": max(s.available, len(s))} for s in self.streams}
        streams = {s.name: {**rows[s.name], "warm_up": s.warm_up, "about": s.about} for s in self.streams}
        report = Report(
            title="Residual learners compared",
            summary=" ".join(self.verdicts()),
            tables=self.tables(),
            figures=figures,
            configuration={"learners": list(self.learners), "streams": streams},
            leading=2 if len(self.streams) == 1 else 1,
        )
        report.write(Path(folder))
        return report


def score_table(comparison: Comparison, stream: str) -> Table:
    """Errors, calibration, time and memory of every learner on one stream."""
    best, measure = comparison.best(stream), comparison.measure(stream)
    columns: dict[Column, Callable[[Score], Cell]] = {
        Column("rms / model alone", ".3f"): lambda score: score.rms,
        Column("median / model alone", ".3f"): lambda score: score.median,
        Column(f"{measure} / best", ".3f"): lambda score: (
            None if score is best else comparison.ratio(stream, score.learner, best.learner)
        ),
        Column("NLL [nats]"): lambda score: f"{score.nll:.2f}" if score.nll < 1e3 else f"{score.nll:.1e}",
        Column("90 % coverage [%]", ".0f"): lambda score: 100 * score.coverage,
        Column("time [µs]", ".0f"): lambda score: score.microseconds,
        Column("memory [kB]", ".0f"): lambda score: score.kilobytes,
    }
    items = {score.learner + (" *" if score is best else ""): score for score in comparison.row(stream)}
    one = comparison.stream(stream)
    n, parts = len(one) - one.warm_up, len(one.segments)
    note = f"On {one.used}, of which {n} are scored{f' in {parts} parts' if parts else ''}; "
    d, m = one.x.shape[1], one.y.shape[1]
    note += f"{d} inputs, {m} {'output' if m == 1 else 'outputs'}. * best; below 1 a learner helps. "
    note += f"95 % intervals; {measure} / best is paired: above 1 where its interval is. "
    note += "Median errors decide where 1 % of the rows make more than half of the squared error. "
    note += "NLL: per sample and output. "
    note += "Time: one prediction and one update."
    return Table.of(f"scores_{stream}", f"{stream}: {one.about}", "learner", items, columns, note)


def output_table(comparison: Comparison, stream: str) -> Table:
    """Error of each output in the units of the file, of the few learners that curves are drawn of."""
    one, shown = comparison.stream(stream), curve_learners(comparison, stream)
    columns = ["output", *(Column(name, ".3g") for name in shown)]
    errors = np.transpose([comparison.output_errors(stream, name) for name in shown]).tolist()
    rows: list[list[Cell]] = [[name, *of] for name, of in zip(one.outputs, errors, strict=True)]
    caption = f"{stream}: {comparison.measure(stream)} errors in the units of the file"
    note = "All other errors are means over the outputs, each divided by its deviation in the first tenth."
    return Table(f"outputs_{stream}", caption, columns, rows, note)


def overview_table(comparison: Comparison) -> Table:
    """Error over that of the model alone: learners by streams, and the mean rank."""
    names = [stream.name for stream in comparison.streams]
    ranks = comparison.ranks().mean(0)
    best = {name: comparison.best(name).learner for name in names}
    rows: list[list[Cell]] = []
    for learner, rank in sorted(zip(comparison.learners, ranks, strict=True), key=lambda pair: pair[1]):
        figures = ((comparison.error(name, learner).mean, best[name] == learner) for name in names)
        cells = (f"{mean:.3f}{' *' if first else ''}" for mean, first in figures)
        rows.append([learner, *cells, float(rank)])
    heads = [name + (", median" if comparison.measure(name) == "median" else "") for name in names]
    columns = ["learner", *heads, Column("mean rank", ".1f")]
    return Table("overview", "rms error / that of the model alone", columns, rows, "* best.")


def curve_learners(comparison: Comparison, stream: str, most: int = 6) -> Sequence[str]:
    """The model alone, the default learner and the best few: more curves cannot be followed."""
    order = sorted(comparison.row(stream), key=lambda score: comparison.error(stream, score.learner).mean)
    always = {"model alone", "default"} & {*comparison.learners}
    rest = [score.learner for score in order if score.learner not in always]
    chosen = always | {*rest[: most - len(always)]}
    return [name for name in comparison.learners if name in chosen]
