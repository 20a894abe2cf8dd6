"""One figure of the paper's numbers beside those found here: Table II, Fig. 5 and Fig. 6.

The paper's are those of its tables and text; its curves are not in our copy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torch_ekm.experiments.protocols.generalize import TABLE_II
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure
from torch_ekm.experiments.reporting.statistics import ALPHA, DataFrame, learning_curve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NO_COPY = "not in our copy"
#: The last row of Table II as it is printed: E-KM:KM [%].
RATIOS = {"weighted_box": 31.5, "box": 28.5, "bottle": 38.5, "applier": 70.0, "can": 54.5}
#: Section V.A: last index of negative result, trials, last upper boundary [deg].
LAST_NEGATIVE, TRIALS, LAST_UPPER = 16, 45, -0.57
#: Section V.A: the E-KM is ahead after fewer trials.
AHEAD = 10
#: Section V.B: errors of both controllers in the trial that the E-KM does not win are below this [deg].
CAN_TRIAL_2 = 0.5
_PAPER = "#000000"
#: Object -> errors of KM and E-KM [deg].
Errors = Mapping[str, tuple[float, float]]
_NONE = (np.nan, np.nan)


def overview(
    nominal: Errors,
    worn: Errors,
    cells: Sequence[tuple[str, float, float]],
    missing: str,
    curves: tuple[DataFrame, DataFrame],
    events: Sequence[int],
) -> Figure:
    """The paper's numbers beside those found here, a panel for each figure and table that has any.

    Args:
        nominal, worn: steady-state errors in these presets; of objects that are left out there is no bar.
        cells: object and errors of KM and E-KM [deg], target after target.
        missing: what stands in place of cells that there are not.
        curves: prediction errors of E-KM and KM [deg], a row for each seed, a column for each trial.
        events: trials in which something happens.
    """
    figure, axes = new_figure(11.0, 6.4, columns=3, rows=2)
    _draw_errors(axes[0], nominal)
    _draw_ratios(axes[1], nominal, worn)
    _draw_cells(axes[2], cells, missing)
    _draw_curves(axes[3], *curves, events)
    _draw_tests(axes[4], axes[5], *curves)
    for axis in axes:
        axis.title.set_fontsize(10)
        if axis.get_legend_handles_labels()[0]:
            axis.legend(fontsize=7)
    return figure


def _bars(axis: Any, series: Sequence[tuple[str, str, bool, Sequence[float]]]) -> None:
    """Groups of bars, an object each: label, colour, whether it is the paper's, values."""
    width = 0.8 / len(series)
    for k, (label, colour, paper, values) in enumerate(series):
        x = np.arange(len(values)) + (k - (len(series) - 1) / 2) * width
        look = {"facecolor": "none", "edgecolor": colour, "hatch": "////"} if paper else {"facecolor": colour}
        axis.bar(x, values, 0.9 * width, label=label, linewidth=0.8, **look)
    axis.set_xticks(range(len(TABLE_II)), [item.replace("_", "\n") for item in TABLE_II], fontsize=8)
    axis.margins(y=0.35)  # for the legend


def _draw_errors(axis: Any, nominal: Errors) -> None:
    """Table II."""
    series = []
    for k, name in enumerate(("KM", "E-KM")):
        mine = [nominal.get(item, _NONE)[k] for item in TABLE_II]
        series.append((f"{name}, paper", COLOURS[name], True, [pair[k] for pair in TABLE_II.values()]))
        series.append((f"{name}, here", COLOURS[name], False, mine))
    _bars(axis, series)
    axis.set(title="Table II", ylabel="steady-state error [deg]")


def _draw_ratios(axis: Any, nominal: Errors, worn: Errors) -> None:
    """The last row of Table II."""
    series = [("paper", _PAPER, True, [RATIOS[item] for item in TABLE_II])]
    for label, colour, errors in (("here", "E-KM", nominal), ("here, worn hand", "limit", worn)):
        pairs = [errors.get(item, _NONE) for item in TABLE_II]
        series.append((label, COLOURS[colour], False, [100 * ekm / km for km, ekm in pairs]))
    _bars(axis, series)
    axis.set(title="Table II, E-KM:KM", ylabel="E-KM:KM [%]")


def _draw_cells(axis: Any, cells: Sequence[tuple[str, float, float]], missing: str) -> None:
    """Fig. 6: a place for each object and target."""
    axis.set(title=f"Fig. 6 (paper: bars {NO_COPY})", ylabel="steady-state error [deg]")
    if not cells:
        axis.text(0.5, 0.5, missing, ha="center", transform=axis.transAxes, fontsize=8)
        return
    items = [item for item, *_ in cells]
    for k, (name, marker) in enumerate((("KM", "s"), ("E-KM", "o")), start=1):
        values = [cell[k] for cell in cells]
        axis.plot(values, marker, color=COLOURS[name], markersize=4, label=f"{name}, here")
    places = {item: [k for k, one in enumerate(items) if one == item] for item in items}
    if "can" in places:
        x, label = places["can"][1], "paper, can, trial 2: both below"
        axis.plot([x - 0.6, x + 0.6], [CAN_TRIAL_2] * 2, color=_PAPER, linewidth=1.5, label=label)
    middles = [float(np.mean(there)) for there in places.values()]
    axis.set_xticks(middles, [item.replace("_", "\n") for item in places], fontsize=8)
    axis.set_ylim(0, max(1.35 * max(max(cell[1:]) for cell in cells), 1.6 * CAN_TRIAL_2))


def _draw_curves(axis: Any, ekm: DataFrame, km: DataFrame, events: Sequence[int]) -> None:
    """Fig. 5a: median and quartiles over seeds."""
    for name, errors in (("KM", km), ("E-KM", ekm)):
        low, high = (errors.quantile(share) for share in (0.25, 0.75))
        axis.fill_between(errors.columns, low, high, color=COLOURS[name], alpha=0.2, linewidth=0)
        axis.plot(errors.columns, errors.median(), color=COLOURS[name], label=f"{name}, here")
    axis.axvspan(1, AHEAD, color=_PAPER, alpha=0.06, linewidth=0, label="paper: E-KM ahead by its end")
    for event in events:
        axis.axvline(event, color=COLOURS["limit"], linewidth=0.8, linestyle=":")
    axis.set(title=f"Fig. 5a (paper: curve {NO_COPY})", xlabel="trial", ylabel="prediction error [deg]")
    axis.set_ylim(0, 1.35 * float(km.quantile(0.75).max()))


def _draw_tests(left: Any, right: Any, ekm: DataFrame, km: DataFrame) -> None:
    """Fig. 5b: p(k) and b(k) of each hand."""
    for k, seed in enumerate(ekm.index):
        one = learning_curve(ekm.loc[seed].dropna().to_numpy(), km.loc[seed].dropna().to_numpy())
        style = {
            "color": COLOURS["E-KM"],
            "alpha": 0.5,
            "linewidth": 0.9,
            "label": None if k else "here, each hand",
        }
        trials = np.arange(1, len(one.p) + 1)
        left.plot(trials, one.p, **style)
        right.plot(trials, one.upper, **style)
    left.axhline(ALPHA, color=COLOURS["limit"], linewidth=0.8, linestyle="--")
    left.plot([LAST_NEGATIVE], [ALPHA], "*", color=_PAPER, markersize=11, label=f"paper: {LAST_NEGATIVE}")
    left.set(
        title="Fig. 5b, p(k); last index of negative result", xlabel="trials k", ylabel="p(k)", yscale="log"
    )
    right.axhline(0, color=COLOURS["limit"], linewidth=0.8, linestyle="--")
    right.plot([TRIALS], [LAST_UPPER], "*", color=_PAPER, markersize=11, label=f"paper: {LAST_UPPER}")
    right.set(
        title="Fig. 5b, b(k); last upper boundary", xlabel="trials k", ylabel="b(k) [deg]", ylim=(-1, 0.5)
    )
