"""Figures of a comparison of learners: one function each, colour-blind-safe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..reporting.plots import COLOURS, new_figure
from .scores import Comparison

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WINDOWS = 25  # of a learning curve
_BLUE, _GREY = COLOURS["E-KM"], COLOURS["KM"]
_ALWAYS = {"model alone": _GREY, "default": _BLUE}
_CYCLE = ("#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")


def plot_scores(comparison: Comparison) -> Figure:
    """Error over that of the model alone, with 95 % intervals: a panel for each stream; ours are blue."""
    n = len(comparison.streams)
    columns = min(n, 3)
    rows = -(-n // columns)
    width, height = 3.2 * columns + 1.2, (0.22 * len(comparison.learners) + 1.0) * rows
    figure, axes = new_figure(width, height, columns, rows, sharey=True)
    y = np.arange(len(comparison.learners))
    for axis, stream in zip(axes, comparison.streams, strict=False):
        scores, best = comparison.row(stream.name), comparison.best(stream.name)
        errors = [comparison.error(stream.name, score.learner) for score in scores]
        for i, (score, error) in enumerate(zip(scores, errors, strict=True)):
            colour = _BLUE if score.learner == "default" or "SOGP" in score.learner else _GREY
            axis.plot([error.low, error.high], [i, i], color=colour, linewidth=1.6)
            filled = colour if score is best else "white"
            axis.plot(error.mean, i, "o", color=colour, markerfacecolor=filled, markersize=5.5)
        axis.axvline(1, color="black", linewidth=0.8, linestyle="--")
        medians = ", medians" if comparison.measure(stream.name) == "median" else ""
        axis.set_title(stream.name + medians, loc="left", fontsize=10)
        axis.set_xlim(0, min(max(1.15, 1.1 * max(error.mean for error in errors)), 2.0))
        axis.grid(axis="y", visible=False)
        axis.grid(axis="x")
    for axis in axes[::columns]:
        axis.set_yticks(y, comparison.learners, fontsize=8)
    axes[0].set_ylim(len(comparison.learners) - 0.4, -0.6)  # shared by all panels
    for axis in axes[n:]:
        axis.set_visible(False)
    figure.supxlabel("error / that of the model alone (95 % interval); filled: best", fontsize=9)
    return figure


def plot_learning_curves(
    comparison: Comparison, stream: str, learners: Sequence[str] | None = None
) -> Figure:
    """Error over the time of one stream, in windows; ``learners``: those that are drawn, all if None."""
    figure, (axis,) = new_figure(7.5, 3.4)
    one = comparison.stream(stream)
    n = len(one) - one.warm_up
    edges = np.linspace(0, n, min(_WINDOWS, n // 5) + 1).astype(int)
    middle = one.warm_up + 0.5 * (edges[1:] + edges[:-1])
    others, measure = iter(_CYCLE * 3), comparison.measure(stream)
    reduce = np.mean if measure == "rms" else np.median
    for name in learners or comparison.learners:
        colour = _ALWAYS[name] if name in _ALWAYS else next(others)
        windowed = np.split(comparison.errors[stream, name], edges[1:-1])
        error = np.sqrt([reduce(squared) for squared in windowed])
        axis.plot(middle, error, color=colour, linewidth=1.4, label=name)
    unit = f"sd of y in the first {one.warm_up}" if one.warm_up else "units of the recording"
    axis.set(xlabel="sample", ylabel=f"{measure} error [{unit}]", ylim=(0, None))
    axis.set_title(f"{stream}: {one.about}", loc="left", fontsize=9)
    axis.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
