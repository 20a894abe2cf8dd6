"""Figures: one function each, colour-blind-safe, from plain arrays; saved as SVG and PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..._extras import require
from ..._files import make_folder, told_as_output_error
from ...exceptions import ShapeError
from ...typing import Array
from .report import FigureFile
from .statistics import ALPHA, learning_curve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ...model import Calibration


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
    """Write ``name.svg`` and ``name.png`` into ``folder``, which is made if it is not there."""
    make_folder(folder)
    # the same figure gives the same files: identifiers of an SVG would be drawn at random, and dated
    style = require("matplotlib.style").context(STYLE)
    with told_as_output_error(folder / f"{name}.svg"), style:
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        figure.savefig(folder / f"{name}.png", dpi=150)
    return FigureFile(f"{name}.svg", caption)


def plot_prediction_error(
    ekm_deg: Array,
    km_deg: Array,
    xlabel: str = "trial",
    trials: Array | None = None,
    events: Mapping[int, str] | None = None,
) -> Figure:
    """Prediction errors of E-KM and KM over the trials (the paper's Fig. 5a).

    Args:
        ekm_deg: ``(n_runs, n_trials)`` absolute errors [deg]; a single run may be ``(n_trials,)``.
        km_deg: the same for the kinematic model on the same motions.
        trials: their numbers ``(n_trials,)``; None: 1, 2, 3...
        events: number of a trial -> what happened in it.
    """
    ekm_deg, km_deg = np.atleast_2d(ekm_deg), np.atleast_2d(km_deg)
    if ekm_deg.shape != km_deg.shape:
        raise ShapeError("km_deg", f"{ekm_deg.shape}, that of ekm_deg", km_deg.shape)
    figure, (axis,) = new_figure(7.0, 3.4)
    k = np.arange(1, ekm_deg.shape[1] + 1) if trials is None else trials
    for name, values in (("KM", km_deg), ("E-KM", ekm_deg)):
        middle = np.nanmedian(values, axis=0)
        if len(values) > 1:
            low, high = np.nanpercentile(values, [25, 75], axis=0)
            axis.fill_between(k, low, high, color=COLOURS[name], alpha=0.2, linewidth=0)
        axis.plot(k, middle, color=COLOURS[name], marker=_MARKERS[name], markersize=3.5, label=name)
    axis.set(xlabel=xlabel, ylabel="prediction error [deg]", ylim=(0, None))
    axis.xaxis.get_major_locator().set_params(integer=True)
    for trial, what in (events or {}).items():
        axis.axvline(trial, color=COLOURS["limit"], linewidth=1, linestyle=":")
        axis.annotate(
            what, (trial, 0.98), xycoords=("data", "axes fraction"), rotation=90, fontsize=7,
            ha="right", va="top", color=COLOURS["limit"],
        )  # fmt: skip
    quartiles = " (median, quartiles)" if len(ekm_deg) > 1 else ""
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


def plot_steady_state_error(errors_deg: dict[str, dict[str, Array]], what: str = "") -> Figure:
    """Steady-state error of each controller for each target (the paper's Fig. 6): every run and the mean.

    A few turns at many times the error of all others are crosses at the upper edge; a mean that they carry
    beyond it is written there.

    Args:
        errors_deg: controller -> target -> ``(n_runs,)`` absolute errors [deg].
        what: named in the title.
    """
    top = _top(errors_deg)
    targets = list(next(iter(errors_deg.values())))
    figure, (axis,) = new_figure(max(4.0, 1.3 * len(targets)), 3.4)
    width = 0.8 / len(errors_deg)
    for j, (name, by_target) in enumerate(errors_deg.items()):
        colour = COLOURS.get(name, f"C{j}")
        for i, target in enumerate(targets):
            values = np.asarray(by_target[target], dtype=float)
            if not values.size:
                continue
            x = i + (j - (len(errors_deg) - 1) / 2) * width
            label = name if i == 0 else None
            axis.bar(x, values.mean(), width * 0.9, color=colour, alpha=0.45, label=label)
            at = x + (np.linspace(-0.3, 0.3, len(values)) * width if len(values) > 1 else np.zeros(1))
            inside = values <= top
            axis.plot(at[inside], values[inside], _MARKERS.get(name, "o"), color=colour, markersize=3)
            axis.plot(at[~inside], [0.97 * top] * int((~inside).sum()), "x", color=colour)
            if values.mean() > top:
                note = {"xytext": (-9, 0), "textcoords": "offset points", "fontsize": 8, "ha": "right"}
                axis.annotate(f"mean {values.mean():.1f}", (x, 0.9 * top), **note)
    axis.set_xticks(range(len(targets)), targets)
    limits = (0, top if np.isfinite(top) else None)
    axis.set(xlabel="target [deg]", ylabel="steady-state error [deg]", ylim=limits)
    axis.set_title(f"Steady-state error{', ' + what if what else ''}", loc="left")
    axis.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def _top(errors_deg: dict[str, dict[str, Array]]) -> float:
    """Upper edge of the errors [deg]; infinite: all of them are shown."""
    everything = np.concatenate([np.ravel(v) for t in errors_deg.values() for v in t.values()])
    top = 1.3 * float(np.percentile(everything, 95)) if everything.size else 1.0
    return top if everything.size and everything.max() > 2 * top else np.inf


def crosses_caption(errors_deg: dict[str, dict[str, Array]]) -> str:
    """What the crosses in :func:`plot_steady_state_error` are; "": there are none."""
    top = _top(errors_deg)
    if not np.isfinite(top):
        return ""
    beyond = sum(int((np.asarray(v) > top).sum()) for t in errors_deg.values() for v in t.values())
    return f" Crosses at the upper edge: {beyond} turn{'' if beyond == 1 else 's'} above {top:.1f} deg."


def plot_convergence(histories_deg: dict[str, list[Array]], target: str = "") -> Figure:
    """|e| over the steps of each manipulation: controller -> list of ``(n_steps,)`` errors [deg]."""
    figure, (axis,) = new_figure(6.0, 3.4)
    for j, (name, runs) in enumerate(histories_deg.items()):
        colour = COLOURS.get(name, f"C{j}")
        for i, run in enumerate(runs):
            axis.plot(run, color=colour, alpha=0.6, linewidth=1.1, label=name if i == 0 else None)
    axis.set(xlabel="motion", ylabel="measured error [deg]", ylim=(0, None))
    axis.set_title(f"Error on the way{' to ' + target if target else ''}", loc="left")
    axis.legend(frameon=False)
    return figure


def plot_bank(
    objects: Sequence[str], models: Sequence[int | None], posteriors: Sequence[Sequence[float]]
) -> Figure:
    """Which model of an object memory each turn went to (None: to none), and how sure it was: the
    probabilities of the models at its end."""
    names = list(dict.fromkeys(objects))
    figure, (axis,) = new_figure(8.0, 3.2)
    palette = list(COLOURS.values())
    for k, (name, model, posterior) in enumerate(zip(objects, models, posteriors, strict=True), start=1):
        if model is None:
            continue
        sure = min(max(posterior), 1.0)  # sums of probabilities end an ulp above
        style = {"color": palette[model % len(palette)], "alpha": 0.25 + 0.75 * sure}
        axis.plot(k, names.index(name), "osD^v*PX"[model % 8], **style)
    used = sorted({model for model in models if model is not None})
    for model in used:
        axis.plot([], [], "osD^v*PX"[model % 8], color=palette[model % len(palette)], label=f"model {model}")
    axis.set_yticks(range(len(names)), names)
    axis.set(xlabel="turn")
    axis.set_title("Which model took the turn (pale: unsure)", loc="left")
    if used:
        axis.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def plot_calibration(calibration: Calibration) -> Figure:
    """What a calibration of a hand found, and the errors of its motions before and after.

    Left: each figure that the data tell, with its standard error, in units of its prior (0: as described).
    Right: errors of the object's rotation.
    """
    told = np.array([row.identifiable for row in calibration.parameters], dtype=bool)
    rows = [row for row in calibration.parameters if row.identifiable]
    x, error = calibration.x[told], np.sqrt(np.diag(calibration.covariance))[told]
    figure, (left, right) = new_figure(9.0, max(3.0, 0.22 * len(rows)), columns=2)
    left.errorbar(x, np.arange(len(rows)), xerr=error, fmt="o", color=COLOURS["E-KM"], markersize=4)
    left.axvline(0, color=COLOURS["KM"], linewidth=1)
    left.set_yticks(range(len(rows)), [row.label for row in rows], fontsize=7)
    left.invert_yaxis()
    left.set(xlabel="from the description, in standard deviations of the prior")
    for errors, name, colour in (
        (calibration.errors_before, "before", COLOURS["KM"]),
        (calibration.errors_after, "after", COLOURS["E-KM"]),
    ):
        degrees = np.degrees(np.linalg.norm(errors[:, -3:], axis=1))
        right.plot(np.arange(1, len(degrees) + 1), degrees, "o-", color=colour, markersize=3.5, label=name)
    right.set(xlabel="motion", ylabel="error of the predicted rotation [deg]", ylim=(0, None))
    right.legend(frameon=False)
    return figure
