"""The benchmark as a page: tables, targets, predicted paths, error by horizon."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from bars import Target, targets_table

from torch_ekm.experiments.reporting.plots import new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table

from .benchmark import CURVE, HORIZONS, LEARNER, SUBSETS, RecordedHandResult
from .nominal import NOMINALS
from .recordings import APART, STEP
from .scores import COORDINATES, compare_errors, score

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CONSTANT, _PUBLISHED, _CALIBRATED, _ONLINE = (
    "constant Jacobian, play", "KM, published figures, play", "KM, calibrated, play",
    "KM, figures online, play",
)  # fmt: skip
_COLOURS = {_CONSTANT: "#E69F00", _PUBLISHED: "#009E73", _CALIBRATED: "#0072B2", _ONLINE: "#CC79A7"}
_SUBSET_WORDS = {
    "all": "all samples",
    "first": "the first 50 samples of each object",
    "first, smooth": "the first 50 samples of each object, poses smoothed over five frames",
    "changed": "a command changed in the second before or on the way",
}
_BARS = (
    (_PUBLISHED, 10, {"x": 0.62, "y": 0.80}),
    (_PUBLISHED, 50, {"x": 0.38, "y": 0.62}),
    (_CALIBRATED, 10, {"x": 0.61, "y": 0.76}),
    (_CALIBRATED, 50, {"x": 0.37, "y": 0.53}),
)
_LEARNED_BARS = (("all", 0.68, 0.44), ("first", 0.62, 0.33))
"""Set as two figures without a word of which: both readings, x and y or rms and median, are shown."""
_PICTURED = ("cyl35_red_d_v0", "sqr30_d_v0", "egg50_d_v0")


def write_report(result: RecordedHandResult, folder: str | Path) -> Report:
    """Tables as CSV, figures as SVG and PNG, and ``index.html`` with all of them, into ``folder``."""
    save = partial(save_figure, folder=Path(folder))
    names = [name for name in _PICTURED if name in result.paths] or result.reported[:3]
    caption = "Recorded paths (grey) and each model's prediction of the object after five seconds."
    figures = [
        save(plot_paths(result, names), name="paths", caption=caption),
        save(plot_horizons(result), name="horizons", caption="Error of the models alone, by horizon."),
    ]
    tables = [score_table(result, h, subset) for h in HORIZONS for subset in SUBSETS]
    tables += [paired_table(result), object_table(result)]
    if not result.quick:
        tables = [*(t for t in [targets_table(targets(result))] if t.rows), *tables]
    report = Report(
        title="Recorded motions of a Yale T42, predicted",
        summary=summary(result),
        tables=tables,
        figures=figures,
        configuration={
            "apart": APART,
            "objects": result.reported,
            "samples": {str(h): _count(result, h) for h in result.samples},
            "calibration": result.calibration,
            "quick": result.quick,
        },
    )
    report.write(Path(folder))
    return report


def summary(result: RecordedHandResult) -> str:
    """The main figures in a few sentences."""
    horizon = HORIZONS[-1]
    said = [
        f"{len(result.reported)} objects on which nothing was identified; error over motion, "
        f"{horizon * STEP:g} s ahead."
    ]
    for name in (_CONSTANT, _PUBLISHED, _CALIBRATED, _ONLINE):
        ratio = result.row(name, horizon).ratio
        said.append(f"{name}: x {ratio['x'].mean:.2f}, y {ratio['y'].mean:.2f}.")
    for learned in (f"{_CALIBRATED} + {LEARNER}", f"{_ONLINE} + {LEARNER}"):
        if any(row.name == learned for row in result.rows):
            ratio = result.row(learned, horizon).ratio
            said.append(f"{learned}: x {ratio['x'].mean:.2f}, y {ratio['y'].mean:.2f}.")
    return " ".join(said)


def score_table(result: RecordedHandResult, horizon: int, subset: str) -> Table:
    """Every way to predict at one horizon, on some of the samples."""
    rows = [row for row in result.rows if (row.horizon, row.subset) == (horizon, subset)]
    columns = [Column(c, ".3f") for c in COORDINATES]
    cells: list[list[Cell]] = [
        [row.name, *(row.ratio[c] for c in COORDINATES), row.rms, row.median] for row in rows
    ]
    note = (
        "rms error over rms motion, both cut at their 99 % quantile, 95 % interval over objects; 1: as if "
        "nothing moved. Last two: of all three coordinates in units of their spread, not cut, mean over "
        "objects (the median of those that move in more than half of the samples)."
    )
    return Table(
        f"scores_{horizon}_{subset.replace(', ', '_')}",
        f"{horizon * STEP:g} s ahead: {_SUBSET_WORDS[subset]}",
        ["prediction", *columns, Column("rms", ".3f"), Column("median", ".3f")],
        cells,
        note,
    )


def paired_table(result: RecordedHandResult) -> Table:
    """What a better nominal model and what a learner gain, on the same samples."""
    rows: list[list[Cell]] = []
    for horizon in HORIZONS:
        taken = {name: result.samples[horizon][name] for name in result.reported}
        pairs = [(_PUBLISHED, _CONSTANT), (_CALIBRATED, _CONSTANT), (_CALIBRATED, _PUBLISHED)]
        pairs += [(_ONLINE, _PUBLISHED), (_ONLINE, _CALIBRATED)]
        learned = [f"{n.name} + {LEARNER}" for n in NOMINALS]
        if (learned[0], horizon) in result.predicted:
            pairs += [(ours, n.name) for ours, n in zip(learned, NOMINALS, strict=True)]
            pairs += [
                (f"{_CALIBRATED} + {LEARNER}", other) for other in (learned[0], f"{_CONSTANT} + {LEARNER}")
            ]
        for ours, theirs in pairs:
            ratio = compare_errors(taken, result.predicted[ours, horizon], result.predicted[theirs, horizon])
            rows.append([f"{horizon * STEP:g} s", ours, theirs, *(ratio[c] for c in COORDINATES)])
    columns = ["ahead", "error of", "over that of", *(Column(c, ".3f") for c in COORDINATES)]
    return Table(
        "paired", "Pairs on the same samples, all", columns, rows, "95 % interval over objects, paired."
    )


def object_table(result: RecordedHandResult) -> Table:
    """Each object: what could be seen of it, and the models alone at the longer horizon."""
    horizon, models = HORIZONS[-1], (_PUBLISHED, _CALIBRATED)
    rows: list[list[Cell]] = []
    for name in result.reported:
        states, taken = result.states[name], {name: result.samples[horizon][name]}
        markers = np.concatenate([path.markers for path in result.paths[name]])
        hidden = np.isnan(markers).any((1, 2)).mean()
        errors = [
            score(m, horizon, "all", taken, {name: result.predicted[m, horizon][name]}, np.ones(3)).ratio
            for m in models
        ]
        row: list[Cell] = [name, float(hidden), float(states.found.mean())]
        row.append(1e3 * float(np.median(states.diameter)))
        rows.append([*row, *(ratio[c].mean for c in ("x", "y") for ratio in errors)])
    columns = [
        "object",
        Column("a marker hidden [%]", ".0f", percent=True),
        Column("both pads brought to touch [%]", ".0f", percent=True),
        Column("diameter [mm]", ".0f"),
        *(Column(f"{c}: {kind}", ".2f") for c in ("x", "y") for kind in ("published", "calibrated")),
    ]
    caption = f"Object by object, {horizon * STEP:g} s ahead, with play, no learner"
    return Table("objects", caption, columns, rows, "Errors cut at each object's own 99 % quantile.")


def targets(result: RecordedHandResult) -> list[Target]:
    """What was aimed at on the real recordings."""
    found = []
    for name, horizon, bars in _BARS:
        ratio = result.row(name, horizon).ratio
        for c, most in bars.items():
            found.append(Target(f"{name}: {c}, {horizon * STEP:g} s ahead", ratio[c].mean, most))
    learned = f"{_CALIBRATED} + {LEARNER}"
    if (learned, HORIZONS[-1]) in result.predicted:
        for subset, first, second in _LEARNED_BARS:
            row = result.row(learned, HORIZONS[-1], subset)
            what = f"{learned}, {HORIZONS[-1] * STEP:g} s ahead, {_SUBSET_WORDS[subset]}"
            for part, measured, most in (
                ("x", row.ratio["x"].mean, first),
                ("y", row.ratio["y"].mean, second),
                ("rms of all coordinates", row.rms, first),
                ("median of all coordinates", row.median, second),
            ):
                found.append(Target(f"{what}: {part}", measured, most))
    return found


def plot_paths(result: RecordedHandResult, names: list[str]) -> Figure:
    """Longest path of each object, and the predicted motion from every fifth second on."""
    horizon = HORIZONS[-1]
    figure, axes = new_figure(4.2 * len(names), 4.0, columns=len(names))
    for axis, name in zip(axes, names, strict=True):
        taken = result.samples[horizon][name]
        number = int(np.argmax([len(path) for path in result.paths[name]]))
        pose, own = result.paths[name][number].pose, taken.path == number
        starts = result.states[name].step[taken.row[own]]
        axis.plot(*(1e3 * pose[:, :2]).T, color="0.75", linewidth=3, label="recorded", zorder=1)
        axis.plot(*(1e3 * pose[starts, :2]).T, ".", color="0.4", markersize=4, zorder=3)
        for label, colour in _COLOURS.items():
            step = result.predicted[label, horizon][name][own, :2]
            for k, start in enumerate(starts):
                line = 1e3 * np.array([pose[start, :2], pose[start, :2] + step[k]])
                axis.plot(*line.T, color=colour, linewidth=1.3, label=label if k == 0 else None, zorder=2)
        axis.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
        axis.set_title(name.removesuffix("_d_v0"), loc="left", fontsize=10)
    axes[0].legend(frameon=False, fontsize=7)
    return figure


def plot_horizons(result: RecordedHandResult) -> Figure:
    """rms error over rms motion of the models alone, x and y."""
    figure, axes = new_figure(8.0, 3.6, columns=2, sharey=True)
    horizons = [h for h in CURVE if h in result.samples]
    for axis, c in zip(axes, ("x", "y"), strict=True):
        for nominal in NOMINALS[1:]:
            ratio = [result.row(nominal.name, h).ratio[c] for h in horizons]
            seconds = [h * STEP for h in horizons]
            colour = _COLOURS.get(nominal.name, "0.6")
            style = "-" if nominal.name in _COLOURS else ("--" if nominal.kind != "published" else ":")
            axis.plot(
                seconds, [r.mean for r in ratio], style, color=colour, label=nominal.name, marker="o", ms=3
            )
            if nominal.name in _COLOURS:
                axis.fill_between(
                    seconds, [r.low for r in ratio], [r.high for r in ratio], color=colour, alpha=0.15
                )
        axis.axhline(1, color="black", linewidth=0.8, linestyle="--")
        axis.set(xlabel="horizon [s]", ylabel="error / motion" if c == "x" else "", ylim=(0, 1.2))
        axis.set_title(c, loc="left", fontsize=10)
    axes[-1].legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _count(result: RecordedHandResult, horizon: int) -> int:
    return sum(len(result.samples[horizon][name].motion) for name in result.reported)
