"""A comparison of learners as tables and as a report folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..learners import learner_factory
from ..reporting.plots import save_figure
from ..reporting.report import FigureFile, Report, Table
from .compare import Comparison, compare, verdicts
from .learners import DEFAULT
from .plots import plot_cost, plot_learning_curves, plot_ranks, plot_scores
from .recording import LIMIT, load_recording, load_table


def score_table(comparison: Comparison, recording: str) -> Table:
    """Every learner on one recording."""
    header = ["learner", "rms / model", "95 % interval", "median / model", "NLL", "90 % coverage", "µs", "kB"]
    best = comparison.best(recording)
    rows = [
        [
            score.learner + (" *" if score is best else ""),
            f"{score.rms.mean:.3f}",
            f"{score.rms.low:.3f} to {score.rms.high:.3f}",
            f"{score.median:.3f}" if np.isfinite(score.median) else "-",
            f"{score.nll:.2f}" if score.nll < 1e3 else f"{score.nll:.1e}",
            f"{100 * score.coverage:.0f} %",
            f"{score.microseconds:.0f}",
            f"{score.kilobytes:.0f}",
        ]
        for score in comparison.row(recording)
    ]
    one = next(r for r in comparison.recordings if r.name == recording)
    n, parts = len(one) - one.warm_up, len(one.segments)
    caption = f"{recording}: {one.about}"
    note = f"{n} samples scored{f' in {parts} parts' if parts else ''}, "
    note += f"{one.x.shape[1]} inputs, {one.y.shape[1]} outputs."
    return Table(f"scores_{recording}", caption, header, rows, note)


def overview_table(comparison: Comparison) -> Table:
    """rms error over that of the model alone: learners by recordings, and the mean rank."""
    names = [recording.name for recording in comparison.recordings]
    ranks = comparison.ranks().mean(0)
    best = {name: comparison.best(name).learner for name in names}
    rows = [
        [
            learner,
            *(
                f"{comparison.scores[name, learner].rms.mean:.3f}{' *' if best[name] == learner else ''}"
                for name in names
            ),
            f"{rank:.1f}",
        ]
        for learner, rank in sorted(zip(comparison.learners, ranks, strict=True), key=lambda pair: pair[1])
    ]
    difference = comparison.critical_difference()
    note = "* best of its column."
    if np.isfinite(difference):
        note += f" Mean ranks closer than {difference:.1f} cannot be told apart (Nemenyi, 5 %)."
    return Table(
        "overview", "rms error / that of the model alone", ["learner", *names, "mean rank"], rows, note
    )


def write_comparison(comparison: Comparison, folder: Path) -> Report:
    """Tables as CSV, figures as SVG and PNG, one page with all, into ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    figures = []
    drawn = {"scores": (plot_scores(comparison), "rms error over that of the model alone, 95 % intervals.")}
    if len(comparison.recordings) > 1:
        drawn["ranks"] = (plot_ranks(comparison), "Mean ranks; overlapping bars cannot be told apart.")
    drawn["cost"] = (plot_cost(comparison), "Accuracy against time.")
    for recording in comparison.recordings:
        figure = plot_learning_curves(comparison, recording.name, curve_learners(comparison, recording.name))
        drawn[f"curve_{recording.name}"] = (figure, f"Learning curves on {recording.name}.")
    for name, (figure, caption) in drawn.items():
        save_figure(figure, folder, name)
        figures.append(FigureFile(f"{name}.svg", caption))
    tables = [score_table(comparison, recording.name) for recording in comparison.recordings]
    if len(tables) > 1:
        tables.insert(0, overview_table(comparison))
    report = Report(
        title="Residual learners compared",
        summary=" ".join(verdicts(comparison)),
        tables=tables,
        figures=figures,
        configuration={
            "learners": list(comparison.learners),
            "recordings": {
                r.name: {"samples": len(r), "warm_up": r.warm_up, "about": r.about}
                for r in comparison.recordings
            },
        },
    )
    report.write(folder)
    return report


def compare_data(
    data: Sequence[str],
    learners: Sequence[str],
    targets: Sequence[str],
    folder: Path,
    limit: int | None = LIMIT,
    processes: int = 1,
    on_total: Callable[[int], None] | None = None,
    on_done: Callable[[str], None] | None = None,
) -> Report:
    """What ``torch-ekm compare`` does: read, compare, and leave the report in ``folder``.

    Args:
        data: names of recordings, or paths.
        learners: the default ones if there are none.
        targets: columns to predict, in files.
        on_total: called with the number of jobs before they start.

    Raises:
        UnknownNameError, DescriptionError: see :func:`load_recording`; nothing has run.
    """
    learners = tuple(learners) or DEFAULT
    for name in learners:
        learner_factory(name)
    recordings = [
        load_table(name, targets, limit)
        if targets and Path(name).suffix
        else load_recording(name, None, limit)
        for name in data
    ]
    if on_total is not None:
        on_total(len(recordings) * len(learners))
    comparison = compare(recordings, learners, folder=folder / "runs", processes=processes, on_done=on_done)
    return write_comparison(comparison, folder)


def curve_learners(comparison: Comparison, recording: str, most: int = 6) -> Sequence[str]:
    """The model alone and the best few: more curves in one picture cannot be followed."""
    order = sorted(comparison.row(recording), key=lambda score: score.rms.mean)
    chosen = {score.learner for score in order[: most - 1]} | {"model alone"}
    return [name for name in comparison.learners if name in chosen]
