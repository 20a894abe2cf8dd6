"""Tables of the controllers and sentences, which the reports of several protocols share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..._extras import require
from ...control import StopReason
from ...typing import Array
from ..config import CONTROLLERS, FIRST_REPORTED
from . import statistics as stats
from .report import Cell, Column, Table
from .statistics import LEAST_SEEDS, DataFrame, Estimate, select

_REACHED = StopReason.REACHED.value
#: What each controller is, in a line.
LEGEND = {
    "KM": "the kinematic model alone; increments are added to what the encoders read",
    "KM+I": "the same model with integral action: increments add up on the set-point; it learns nothing",
    "KM+S": "the same model on the servo inverse, which finds the dead zones of the motors on the encoders",
    "E-KM": "the same servo inverse; the model follows the figures of the hand, which it learns, and a "
    "learner corrects it; it plans whole turns, and goes as far at once as it is sure",
}


def by_controller(trials: DataFrame) -> dict[str, DataFrame]:
    """The turns of each controller that has any."""
    found = {name: select(trials, controller=name, kind="turn") for name in CONTROLLERS}
    return {name: mine for name, mine in found.items() if len(mine)}


def legend(trials: DataFrame) -> dict[str, str]:
    """Say what the controllers are that took part."""
    there = set(trials["controller"])
    return {name: line for name, line in LEGEND.items() if name in there}


def controller_table(trials: DataFrame) -> Table:
    """How the turns of every controller ended, on the same seeds and grasps."""
    columns: dict[Column, Callable[[DataFrame], Cell]] = {
        Column("steady-state error [deg]"): lambda mine: stats.estimate(mine, "error_deg"),
        Column("motions", ".1f"): lambda mine: stats.estimate(mine, "motions"),
        Column("first motion [deg]"): lambda mine: stats.estimate(mine, "first_step_deg"),
        Column("reached"): lambda mine: stats.rate(mine["reason"] == _REACHED),
        Column("lost"): lambda mine: stats.rate(mine["lost"]),
        Column("KM, one motion [deg]"): lambda mine: stats.estimate(mine, "prediction_km"),
        Column("E-KM, one motion [deg]"): lambda mine: stats.estimate(mine, "prediction_ekm"),
    }
    note = (
        "Mean and 95 % bootstrap interval over pairs of object and seed; steady-state errors by the "
        "simulation's truth. A lost object counts with the whole angle of the target. First motion: by how "
        "much more or less it changed the error than it was to. Intervals of rates are Wilson's. One motion: "
        "how far KM and E-KM mispredict what was measured of a motion, before the learner trains on it."
    )
    items = by_controller(trials)
    return Table.of("controllers", "All turns of each controller", "controller", items, columns, note)


def pivot(turns: DataFrame, by: str, split: str, cell: Callable[[DataFrame], Cell], what: str) -> Table:
    """A row for each entry of the column ``split`` and one for all, a column for each of ``by``."""
    names, rows = list(dict.fromkeys(turns[by])), []
    groups = {
        f"{key:g}" if isinstance(key, float) else str(key): mine
        for key, mine in turns.groupby(split, sort=False)
    }
    for key, mine in {**groups, "all": turns}.items():
        found = dict(tuple(mine.groupby(by)))
        rows.append([key, len(mine), *(cell(found[name]) if name in found else None for name in names)])
    name, columns = split.removesuffix("_deg"), [split.replace("_deg", " [deg]"), "turns", *names]
    return Table(f"by_{name}", f"Each {name}: {what}", columns, rows)


def error_table(trials: DataFrame, split: str) -> Table:
    """Steady-state errors and ends of the turns by the entries of a column, such as "object"."""

    def cell(turns: DataFrame) -> str:
        error = stats.estimate(turns, "error_deg")
        return f"{error:.2f}; {turns['lost'].sum()}, {turns['not_reached'].sum()}"

    what = "steady-state error [deg], lost objects with the whole angle; turns lost, and not reached"
    return pivot(select(trials, kind="turn"), "controller", split, cell, what)


def reason_table(trials: DataFrame) -> Table:
    """Why the turns of each controller ended, and how far from the target."""

    def cell(turns: DataFrame) -> str:
        error = turns["true_error_deg"][~turns["lost"]].astype(float).mean()
        return f"{len(turns)}{'' if np.isnan(error) else f' ({error:.2f})'}"

    what = "why turns ended, and their mean true error [deg] where the object was not lost"
    return pivot(trials[trials["kind"] == "turn"], "controller", "reason", cell, what)


def ratio(trials: DataFrame, theirs: str) -> Estimate | None:
    """Mean error of the E-KM over that of another controller, on the units that both have."""
    mine, other = (select(trials, controller=name, kind="turn") for name in ("E-KM", theirs))
    ours, others = stats.paired_means(mine, other, "error_deg")
    return stats.bootstrap_ratio(ours, others) if len(ours) and others.mean() else None


def p_row(hands: Sequence[tuple[Array, Array]], paper: str) -> list[Cell]:
    """p of the paper's two-sided test of two samples on each hand alone: the median."""
    each = [require("scipy.stats").ttest_ind(*hand).pvalue for hand in hands if len(hand[0]) > 1]
    return ["p of two samples, one hand (median)", paper, f"{np.median(each):.1e}" if each else None]


def verdict(trials: DataFrame, seeds: Sequence[int]) -> str:
    """How far from the target each controller ends, what was lost and not reached, and from enough seeds the
    ratios of the E-KM to the others."""
    turns, parts = by_controller(trials), []
    order = [name for name in ("E-KM", "KM+S", "KM+I", "KM") if name in turns]
    ends = [f"{name} {stats.estimate(turns[name], 'error_deg'):.2f} deg" for name in order]
    if ends:
        first = ends[0].replace(" ", " ends ", 1) + " from the target"
        failed = [
            f"{name} {turns[name]['lost'].sum()} and {turns[name]['not_reached'].sum()} of {len(turns[name])}"
            for name in order
        ]
        parts.append(f"The {', '.join([first, *ends[1:]])}, on {len(seeds)} seed{'s' * (len(seeds) > 1)}.")
        parts.append(f"Objects lost, and turns that did not reach the target: {', '.join(failed)}.")
        if 2 * (turns[order[0]]["reason"] == _REACHED).sum() < len(turns[order[0]]):
            parts.append(f"The {order[0]}: {why(turns[order[0]])}")
    ours, theirs = (
        stats.estimate(turns.get("E-KM", trials[:0]), f"prediction_{name}") for name in ("ekm", "km")
    )
    if ours is not None:
        parts.append(f"The E-KM predicts one motion to {ours:.2f} deg, the KM to {theirs:.2f} deg.")
    if len(seeds) >= LEAST_SEEDS and order[:1] == ["E-KM"]:
        found = {name: ratio(trials, name) for name in order[1:]}
        ratios = [f"{name} {100 * one:.0f} %" for name, one in found.items() if one is not None]
        if ratios:
            parts.append(f"Error of the E-KM over that of {', '.join(ratios)} (paired).")
    for name, mine in trials[trials["kind"] == "turn"].groupby("object", sort=False):
        if not mine["grasped"].any():
            parts.append(f"{name} was never grasped ({mine['message'].iloc[-1]}).")
    return f"{' '.join(parts) or 'Nothing to compare.'} {which_seeds(seeds)}"


def why(turns: DataFrame) -> str:
    """The reason for which most of these turns ended, and what was said of it."""
    reasons = turns["reason"].value_counts()
    said = turns.loc[turns["reason"] == reasons.index[0], "message"].mode()[0]
    return f"{reasons.iloc[0]} of {len(turns)} turns ended with '{reasons.index[0]}'{said and f': {said}'}."


def which_seeds(seeds: Sequence[int]) -> str:
    """How many, and what may be concluded from them."""
    few = f" Fewer than {LEAST_SEEDS} seeds: differences are not tested." if len(seeds) < LEAST_SEEDS else ""
    development = min(seeds) < FIRST_REPORTED
    tuned = " Development seeds: figures may have been tuned on them." if development else ""
    which = f"Seed {seeds[0]}." if len(seeds) == 1 else f"Seeds {seeds[0]} to {seeds[-1]}."
    return f"{which}{few}{tuned}"
