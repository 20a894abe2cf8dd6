"""Figures: one function each, colour-blind-safe, from the frame of the trials; saved as SVG."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..._extras import require
from ..._files import make_folder, told_as_output_error
from ...typing import Array
from .report import FigureFile
from .statistics import ALPHA, DataFrame, learning_curve

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: Of every figure, as in ``plt.style.use("torch_ekm.style")``: the file ``style.mplstyle`` of the package.
STYLE = "torch_ekm.style"
#: Okabe and Ito's palette, safe for colour-blind readers; grey for what is compared against.
COLOURS = {"KM": "#7f7f7f", "KM+I": "#E69F00", "KM+S": "#009E73", "E-KM": "#0072B2", "limit": "#D55E00"}
_MARKERS = {"KM": "s", "KM+I": "D", "KM+S": "^", "E-KM": "o"}


def new_figure(width: float, height: float, columns: int = 1, rows: int = 1, sharey: bool = False):
    """A figure of this size [inch] in :data:`STYLE`, and its axes row by row."""
    with require("matplotlib.style").context(STYLE):
        # a Figure of its own: pyplot would keep it alive and touch the caller's backend
        figure = require("matplotlib.figure").Figure(figsize=(width, height))
        axes = figure.subplots(rows, columns, squeeze=False, sharey=sharey)
    return figure, axes.ravel().tolist()


def save_figure(figure: Figure, folder: Path, name: str, caption: str = "") -> FigureFile:
    """Write ``name.svg`` into ``folder``, which is made if it is not there."""
    make_folder(folder)
    # the same figure gives the same files: identifiers of an SVG would be drawn at random, and dated
    style = require("matplotlib.style").context(STYLE)
    with told_as_output_error(folder / f"{name}.svg"), style:
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
    return FigureFile(f"{name}.svg", caption)


def plot_prediction_error(
    ekm: DataFrame, km: DataFrame, xlabel: str = "trial", events: Mapping[int, str] | None = None
) -> Figure:
    """Prediction errors of E-KM and KM over the trials (the paper's Fig. 5a).

    Args:
        ekm: absolute errors [deg], a row for each run, a column for each trial.
        km: the same for the kinematic model on the same motions.
        events: number of a trial -> what happened in it.
    """
    figure, (axis,) = new_figure(7.0, 3.4)
    for name, errors in (("KM", km), ("E-KM", ekm)):
        k = errors.columns.astype(float)
        if len(errors) > 1:
            low, high = (errors.quantile(share) for share in (0.25, 0.75))
            axis.fill_between(k, low, high, color=COLOURS[name], alpha=0.2, linewidth=0)
        axis.plot(k, errors.median(), color=COLOURS[name], marker=_MARKERS[name], markersize=3.5, label=name)
    axis.set(xlabel=xlabel, ylabel="prediction error [deg]", ylim=(0, None))
    axis.xaxis.get_major_locator().set_params(integer=True)
    for trial, what in (events or {}).items():
        axis.axvline(trial, color=COLOURS["limit"], linewidth=1, linestyle=":")
        axis.annotate(
            what, (trial, 0.98), xycoords=("data", "axes fraction"), rotation=90, fontsize=7,
            ha="right", va="top", color=COLOURS["limit"],
        )  # fmt: skip
    quartiles = " (median, quartiles)" if len(ekm) > 1 else ""
    axis.set_title(f"One-step prediction error{quartiles}", loc="left")
    axis.legend(frameon=False)
    return figure


def plot_learning_test(ekm_deg: Array, km_deg: Array) -> Figure:
    """p(k) and b(k) of the first k trials (the paper's Fig. 5b), of ``(n_trials,)`` errors [deg]."""
    curve = learning_curve(ekm_deg, km_deg)
    k = np.arange(1, len(curve.p) + 1)
    figure, (left, right) = new_figure(8.0, 3.2, columns=2)
    left.plot(k, curve.p, color=COLOURS["E-KM"])
    left.axhline(ALPHA, color=COLOURS["limit"], linewidth=1, linestyle="--", label=f"{ALPHA:g}")
    left.set_yscale("log")
    left.set(xlabel="trials k", ylabel="p(k)")
    left.set_title(f"last negative result: {curve.last_negative}", loc="left", fontsize=10)
    left.legend(frameon=False)
    right.plot(k, curve.upper, color=COLOURS["E-KM"])
    right.axhline(0, color=COLOURS["limit"], linewidth=1, linestyle="--")
    right.set(xlabel="trials k", ylabel="b(k) [deg]")
    finite = curve.upper[np.isfinite(curve.upper)]
    if finite.size > 3:  # the first intervals are enormous and hide the rest
        right.set_ylim(1.2 * finite.min(), max(np.percentile(finite, 90), 0.1))
    right.set_title(f"last upper boundary: {curve.last_upper:.2f} deg", loc="left", fontsize=10)
    for axis in (left, right):
        axis.xaxis.get_major_locator().set_params(integer=True)
    return figure


def plot_steady_state_error(turns: DataFrame) -> Figure:
    """Steady-state error of each controller for each object and target (the paper's Fig. 6): every run and
    the mean. A few turns at many times the error of all others are crosses at the upper edge.

    Args:
        turns: of :func:`~torch_ekm.experiments.reporting.statistics.trial_frame`.
    """
    objects, controllers = list(turns.groupby("object", sort=False)), list(turns["controller"].unique())
    columns = min(len(objects), 3)
    rows = -(-len(objects) // columns)
    figure, panels = new_figure(max(6.5, 3.6 * columns), 3.4 if rows == 1 else 2.6 * rows, columns, rows)
    width = 0.8 / len(controllers)
    for axis, (item, mine) in zip(panels, objects, strict=False):
        top, targets = 1.3 * float(mine["error_deg"].quantile(0.95)), sorted(mine["angle_deg"].unique())
        top = top if mine["error_deg"].max() > 2 * top else np.inf
        for (name, target), errors in mine.groupby(["controller", "angle_deg"], sort=False)["error_deg"]:
            j, values = controllers.index(name), errors.to_numpy()
            colour, marker = COLOURS.get(name, f"C{j}"), _MARKERS.get(name, "o")
            x = targets.index(target) + (j - (len(controllers) - 1) / 2) * width
            axis.bar(x, values.mean(), width * 0.9, color=colour, alpha=0.45, label=name)
            at, inside = x + np.linspace(-0.3, 0.3, len(values)) * width, values <= top
            axis.plot(at[inside], values[inside], marker, color=colour, markersize=2)
            axis.plot(at[~inside], [0.97 * top] * int((~inside).sum()), "x", color=colour)
        axis.set_xticks(range(len(targets)), [f"{target:g}" for target in targets])
        axis.set(xlabel="target [deg]", ylim=(0, top if np.isfinite(top) else None))
        axis.set_title(str(item).replace("_", " "), loc="left", fontsize=10)
    for axis in panels[len(objects) :]:
        axis.set_axis_off()
    for axis in panels[: len(objects) : columns]:
        axis.set_ylabel("steady-state error [deg]")
    drawn = dict(zip(*reversed(panels[0].get_legend_handles_labels()), strict=True))
    figure.legend(drawn.values(), drawn.keys(), frameon=False, loc="outside upper right", ncols=4)
    return figure
