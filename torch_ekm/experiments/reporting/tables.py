"""Tables of the controllers and sentences, which the reports of several protocols share."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ..._extras import require
from ...control import StopReason
from ...typing import Array
from ..config import CONTROLLERS, FIRST_REPORTED
from ..records import NOT_GRASPED
from . import statistics as stats
from .report import Cell, Column, Table
from .statistics import LEAST_SEEDS, DataFrame, Estimate
from .trials import select

_REACHED = StopReason.REACHED.value
#: What each controller is, in a line.
LEGEND = {
    "KM": "the kinematic model alone; increments are added to what the encoders read",
    "KM+I": "the same model with integral action: increments add up on the set-point; it learns nothing",
    "KM+S": "the same model on the servo inverse, which finds the dead zones of the motors on the encoders",
    "E-KM": "the same servo inverse; the model follows the figures of the hand, which it learns, and a "
    "learner corrects it; it plans whole turns, and goes as far at once as it is sure",
}
_MEANINGS = {
    StopReason.REACHED.value: "the measured error stays within the tolerance",
    StopReason.STALLED.value: "the error falls no further",
    StopReason.STEP_LIMIT.value: "all motions are used up",
    StopReason.ACTUATOR_LIMITS.value: "the motors that are needed are at the ends of their ranges",
    StopReason.UNSTABLE_GRASP.value: "the model predicts that the grasp buckles, or cannot be held",
    StopReason.GIVEN_UP.value: "no way on was safe; the object is in the hand",
    StopReason.WEAK_GRASP.value: "declined: a finger bore less than the object needs",
    StopReason.OUT_OF_REACH.value: "declined before anything moved",
    StopReason.OBJECT_LOST.value: "the object was dropped, or turned too far off the axis",
    StopReason.FORCE_CEILING.value: "a fingertip pressed harder than the guard allows",
    NOT_GRASPED: "no pinch held the object",
}


def by_controller(trials: DataFrame) -> dict[str, DataFrame]:
    """The turns of each controller that has any."""
    found = {name: select(trials, controller=name, kind="turn") for name in CONTROLLERS}
    return {name: mine for name, mine in found.items() if len(mine)}


def by_object(trials: DataFrame) -> dict[str, DataFrame]:
    """Trials of each object, and of all."""
    return {str(name): mine for name, mine in trials.groupby("object", sort=False)} | {"all": trials}


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
        Column("not reached"): lambda mine: stats.rate(mine["not_reached"]),
        Column("lost"): lambda mine: stats.rate(mine["lost"]),
    }
    note = (
        "Mean and 95 % bootstrap interval over pairs of object and seed; steady-state errors by the "
        "simulation's truth. A lost object counts with the whole angle of the target. First motion: by how "
        "much more or less it changed the error than it was to. Not reached: the object is in the hand, but "
        "not at its target. Intervals of rates are Wilson's."
    )
    items = by_controller(trials)
    return Table.of("controllers", "All turns of each controller", "controller", items, columns, note)


def group_table(trials: DataFrame, by: str, what: str) -> Table:
    """Steady-state errors and ends of the turns by the entries of a column, the E-KM's paired with the KM's.

    Args:
        by: "object" (the paper's Table II), "angle_deg".
        what: the groups in words.
    """
    names, rows = list(by_controller(trials)), []
    turns = trials[trials["kind"] == "turn"]
    tested = trials["seed"].nunique() >= LEAST_SEEDS
    groups = {
        f"{key:g}" if isinstance(key, float) else str(key): mine
        for key, mine in turns.groupby(by, sort=False)
    }
    for key, mine in {**groups, "all": turns}.items():
        found = by_controller(mine)
        errors = [stats.estimate(found[name], "error_deg") if name in found else None for name in names]
        ends = (f"{name} {of['lost'].sum()}, {of['not_reached'].sum()}" for name, of in found.items())
        compared = ratio_and_p(*paired(mine, "E-KM", "KM"), mine["seed"].nunique())
        rows.append([key, *errors, *compared[: 1 + tested], "; ".join(ends)])
    columns = [
        by.replace("_deg", " [deg]"), *(f"{name} [deg]" for name in names),
        Column("E-KM:KM [%]", ".0f", percent=True), *([Column("p paired", ".1g")] if tested else []),
        "lost, not reached",
    ]  # fmt: skip
    note = (
        "Steady-state error, lost objects with the whole angle. Ratio of means with the bootstrap over "
        "pairs of object and seed."
    )
    return Table(f"by_{by.removesuffix('_deg')}", f"Steady-state error of {what}", columns, rows, note)


def reason_table(trials: DataFrame) -> Table:
    """Why the turns of each controller ended, and how far from the target."""
    turns = trials[trials["kind"] == "turn"]
    names = [name for name in CONTROLLERS if (turns["controller"] == name).any()]
    rows: list[list[Cell]] = []
    for reason in [*(reason.value for reason in StopReason), NOT_GRASPED]:
        mine = turns[turns["reason"] == reason].groupby("controller")["survivor_error_deg"]
        if not len(mine):
            continue
        count, mean = mine.size(), mine.mean()
        errors = {name: "" if np.isnan(mean[name]) else f" ({mean[name]:.2f})" for name in count.index}
        cells = [f"{count[name]}{errors[name]}" if name in errors else "-" for name in names]
        rows.append([reason, *cells, _MEANINGS.get(reason, "a guard stopped it")])
    columns = ["reason", *(f"{name}: turns (error [deg])" for name in names), "what it means"]
    note = "Turns, and in brackets the mean true error at their end; none of lost objects."
    return Table("stop_reasons", "Why the turns ended", columns, rows, note)


def paired(trials: DataFrame, ours: str, theirs: str) -> tuple[Array, Array]:
    """Unit means of the steady-state errors of two controllers, for the units that both have."""
    mine, others = (select(trials, controller=name, kind="turn") for name in (ours, theirs))
    return stats.paired_means(mine, others, "error_deg")


def ratio_and_p(ours: Array, theirs: Array, n_seeds: int) -> tuple[Estimate | None, float | None]:
    """Ratio of means, and p of the paired t-test, where there are such and enough seeds."""
    if not len(ours) or theirs.mean() == 0:
        return None, None
    p = stats.paired_p(ours, theirs) if n_seeds >= LEAST_SEEDS else None
    return stats.bootstrap_ratio(ours, theirs), p


def p_rows(hands: Sequence[tuple[Array, Array]], ours: Array, theirs: Array, paper: str) -> list[list[Cell]]:
    """p of the paper's two-sided test of two samples, on each hand alone, and of the paired one on all."""
    each = [require("scipy.stats").ttest_ind(*hand).pvalue for hand in hands if len(hand[0]) > 1]
    p = stats.paired_p(ours, theirs) if len(hands) >= LEAST_SEEDS else None
    one, all_hands = f"{np.median(each):.1e}" if each else None, None if p is None else f"{p:.1e}"
    return [["p of two samples, one hand (median)", paper, one], ["p paired, all hands", None, all_hands]]


def prediction_means(trials: DataFrame, kind: str = "") -> tuple[Array, Array]:
    """Unit means of the one-step prediction errors of E-KM and KM on the E-KM's own motions [deg].

    Args:
        kind: "true_" for errors against the plant's truth.
    """
    mine = select(trials, controller="E-KM", kind="turn").dropna(subset="prediction_ekm")
    return stats.paired_means(mine, mine, f"{kind}prediction_ekm", f"{kind}prediction_km")


def prediction_cells(trials: DataFrame, kind: str = "") -> list[Cell]:
    """KM, E-KM, and their ratio; nothing where no E-KM moved."""
    ours, theirs = prediction_means(trials, kind)
    if not len(ours):
        return [None] * 3
    return [stats.bootstrap_mean(theirs), stats.bootstrap_mean(ours), stats.bootstrap_ratio(ours, theirs)]


def prediction_table(trials: DataFrame) -> Table:
    """One-step prediction error of KM and E-KM on the E-KM's own motions."""
    rows = [
        [name, *prediction_cells(mine), *prediction_cells(mine, "true_")]
        for name, mine in by_object(trials).items()
        if len(prediction_means(mine)[0])
    ]
    columns: list[Column | str] = ["object"]
    for what in ("measured", "true"):
        ratio = Column(f"E-KM:KM, {what} [%]", ".0f", percent=True)
        columns += [f"KM, {what} [deg]", f"E-KM, {what} [deg]", ratio]
    note = (
        "Mean |M_c (ds - prediction)| [deg], the prediction made before the learner trains on the motion. "
        "'Measured' includes the camera's noise, which no model can predict; 'true' does not."
    )
    return Table("prediction", "One-step prediction error", columns, rows, note)


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
    ours, theirs = prediction_means(trials)
    if len(ours):
        wrong = f"{stats.bootstrap_mean(ours):.2f} deg, the KM to {stats.bootstrap_mean(theirs):.2f} deg"
        parts.append(f"The E-KM predicts one motion to {wrong} on the same motions.")
    if len(seeds) >= LEAST_SEEDS and order[:1] == ["E-KM"]:
        found = {name: ratio_and_p(*paired(trials, "E-KM", name), 0)[0] for name in order[1:]}
        ratios = [f"{name} {100 * ratio:.0f} %" for name, ratio in found.items() if ratio is not None]
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
