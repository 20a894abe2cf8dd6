"""The report on foresight: reach, turns beyond Table I, turns with the camera off."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from bars import Target, targets_table

from torch_ekm.control import StopReason
from torch_ekm.experiments.reporting import statistics as stats
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, FigureFile, Report, Table
from torch_ekm.experiments.reporting.statistics import DataFrame, Series
from torch_ekm.experiments.reporting.tables import which_seeds
from torch_ekm.experiments.reporting.trials import select

#: A target is declined where it lies this far beyond the predicted reach [deg].
BEYOND_DEG = 2.0
_NINETY = 1.645  # standard deviations on either side that hold 90 % of a Gaussian
PLANNED = "E-KM"
_BLIND = "blind", "blind, looks again", "blind, no touch"
_FREE = "nothing"
_LEGEND = {
    PLANNED: "plans by f + g, as they are learned",
    "oracle": "plans by the true model, from true poses and forces, without doubts",
}


def reach_errors(turns: DataFrame) -> Series:
    """Predicted end less the real one [deg], of turns that ended and of which an end was predicted."""
    ended = turns[turns["reach_deg"].notna() & (turns["reason"] != StopReason.REACHED.value)]
    return ended["reach_deg"].astype(float).abs() - ended["largest_deg"]


def declined(turns: DataFrame) -> Series:
    """The model said that the target is out of reach."""
    beyond = turns["angle_deg"].abs() > turns["reach_deg"].astype(float).abs() + BEYOND_DEG
    return beyond & (turns["reach_end"] != _FREE)


def covered(turns: DataFrame) -> Series:
    """The error of the estimate lies within the stated 90 % interval."""
    stated = turns[["estimate_error_deg", "axis_std_deg"]].dropna().astype(float)
    return stated["estimate_error_deg"].abs() <= _NINETY * stated["axis_std_deg"]


def by_contender(trials: DataFrame, kind: str | None = None) -> dict[str, DataFrame]:
    """Turns of one kind, or all, of each contender that has any, the E-KM first."""
    wanted = {} if kind is None else {"kind": kind}
    found = {name: mine for name, mine in select(trials, **wanted).groupby("contender", sort=False)}
    return {str(name): found[name] for name in sorted(found, key=lambda name: name != PLANNED)}


def _same_grasps(trials: DataFrame, contender: str) -> DataFrame:
    """Largest angles [deg] of a contender and of the E-KM on each grasp, ``(n, 2)``."""
    far = select(trials, kind="far").pivot(
        index=["object", "seed"], columns="contender", values="largest_deg"
    )
    return far.reindex(columns=[contender, PLANNED]).dropna()


def paired_ratio(trials: DataFrame, contender: str) -> float | None:
    """Median of the largest angle over that of the E-KM, on the same grasps."""
    ours, theirs = _same_grasps(trials, contender).to_numpy().T
    turned = theirs > 1.0
    return float(np.median(ours[turned] / theirs[turned])) if turned.any() else None


def _agreement(trials: DataFrame, contender: str) -> Cell:
    """How often a contender's turn ends within 2 deg of the E-KM's."""
    if contender == PLANNED:
        return None
    ours, theirs = _same_grasps(trials, contender).to_numpy().T
    return stats.rate(np.abs(ours - theirs) <= 2)


def foresight_targets(trials: DataFrame) -> list[Target]:
    """What was aimed at before the figures were known."""
    found: list[Target] = []
    mine = select(trials, contender=PLANNED)
    errors, blind = reach_errors(select(mine, kind="far")), select(mine, kind="blind")
    if len(errors):
        for off, least in ((2, 70), (5, 90)):
            within = 100 * float((errors.abs() <= off).mean())
            found.append(Target(f"reach predicted within {off} deg [% of grasps]", within, least=least))
    if len(blind):
        median = float(blind["true_error_deg"].median())
        found.append(Target("blind turn with touch, median error [deg]", median, most=0.5))
        found.append(Target("its 90 % interval holds [%]", 100 * float(covered(blind).mean()), least=90))
    return found


def foresight_report(seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
    """The answer, the tables and a figure."""
    tables = [
        far_table(trials),
        reach_table(trials),
        beyond_table(trials),
        blind_table(trials),
        targets_table(foresight_targets(trials)),
    ]
    turns = by_contender(trials)
    mine = turns.get(PLANNED, trials[:0])
    figures = [*_reach_plot(mine, folder)]
    title = "Foresight: how far, and what ends it; turns with the camera off"
    ends = [f"{name} {_ends(found)}" for name, found in turns.items()]
    summary = f"{_answer(trials)} Objects lost: {', '.join(ends)}. {which_seeds(seeds)}"
    legend = {name: line for name, line in _LEGEND.items() if name in turns}
    return Report(title, summary, [table for table in tables if table.rows], figures, legend=legend)


def _ends(turns: DataFrame) -> str:
    beyond = turns[turns["kind"] == "turn"]
    missed = f" ({beyond['not_reached'].sum()} of {len(beyond)} beyond Table I not reached)"
    return f"{turns['lost'].sum()} of {len(turns)} turns{missed if len(beyond) else ''}"


def _answer(trials: DataFrame) -> str:
    parts, mine = [], select(trials, contender=PLANNED)
    errors, blind = reach_errors(select(mine, kind="far")).abs(), select(mine, kind="blind")
    if len(errors):
        parts.append(
            f"The end of a turn is predicted to {errors.median():.1f} deg (median), within 2 deg in "
            f"{100 * (errors <= 2).mean():.0f} % of {len(errors)} grasps."
        )
    if len(blind):
        parts.append(
            f"A blind turn of {blind['angle_deg'].iloc[0]:g} deg ends {blind['true_error_deg'].median():.2f} "
            f"deg off (median of {len(blind)}); the stated 90 % interval holds "
            f"{100 * covered(blind).mean():.0f} % of the estimates."
        )
    for name in by_contender(trials):
        ratio = paired_ratio(trials, name)
        if name != PLANNED and ratio is not None:
            parts.append(f"{name} turns {ratio:.2f} times as far as the E-KM (median).")
    return " ".join(parts) or "Nothing was grasped."


def far_table(trials: DataFrame) -> Table:
    """The largest angle of each contender."""
    columns: dict[Column, Callable[[DataFrame], Cell]] = {
        Column("largest angle [deg]", ".1f"): lambda mine: stats.bootstrap_mean(
            mine["largest_deg"].to_numpy()
        ),
        Column("median [deg]", ".1f"): lambda mine: float(mine["largest_deg"].median()),
        Column(f"paired, {PLANNED} = 1"): lambda mine: paired_ratio(trials, mine["contender"].iloc[0]),
        Column(f"within 2 deg of {PLANNED}"): lambda mine: _agreement(trials, mine["contender"].iloc[0]),
        Column("not reached"): lambda mine: stats.rate(mine["not_reached"]),
        Column("lost"): lambda mine: stats.rate(mine["lost"]),
    }
    note = (
        "The target is beyond the reach of all grasps; the largest true angle before the turn ended. How "
        "often two controllers end within 2 deg of each other on the same grasp bounds what can be predicted."
    )
    items = by_contender(trials, "far")
    return Table.of("far", "To the end of the reach", "contender", items, columns, note)


def reach_table(trials: DataFrame) -> Table:
    """How well the end was predicted; of the E-KM for each object and how the turn ended."""
    items: dict[str, DataFrame] = {}
    for name, found in by_contender(trials, "far").items():
        mine = found[found["reach_deg"].notna()]
        items[f"{name}, all"] = mine
        if name == PLANNED:
            items |= _each("object", mine) | _each("reason", mine)
    columns: dict[Column, Callable[[DataFrame], Cell]] = {
        Column("grasps"): lambda mine: len(reach_errors(mine)),
        Column("median absolute error [deg]", ".1f"): lambda mine: float(reach_errors(mine).abs().median()),
        Column("mean error [deg]", "+.1f"): lambda mine: float(reach_errors(mine).mean()),
        Column("within 2 deg"): lambda mine: stats.rate(reach_errors(mine).abs() <= 2),
        Column("within 5 deg"): lambda mine: stats.rate(reach_errors(mine).abs() <= 5),
        Column("ends by (predicted)"): lambda mine: str(mine["reach_end"].mode().iloc[-1]),
    }
    items = {name: mine for name, mine in items.items() if len(reach_errors(mine))}
    note = (
        f"Predicted less real largest angle. Of the {PLANNED} also for each object and, below, by how the "
        "turn really ended."
    )
    return Table.of("reach", "Predicted ends of turns", "turns", items, columns, note)


def beyond_table(trials: DataFrame) -> Table:
    """Turns beyond Table I, and what declining would have spared."""
    columns: dict[Column, Callable[[DataFrame], Cell]] = {
        Column("turns"): len,
        Column("reached"): lambda mine: stats.rate(mine["reason"] == StopReason.REACHED.value),
        Column("not reached"): lambda mine: stats.rate(mine["not_reached"]),
        Column("lost"): lambda mine: stats.rate(mine["lost"]),
        Column("declined"): lambda mine: int(declined(mine).sum()),
        Column("of these lost or not reached"): lambda mine: int(
            (declined(mine) & (mine["lost"] | mine["not_reached"])).sum()
        ),
        Column("lost, not declined"): lambda mine: int((mine["lost"] & ~declined(mine)).sum()),
    }
    note = (
        f"Declined: more than {BEYOND_DEG:g} deg beyond the predicted reach. These turns were made all the "
        "same, to see what declining them would have spared."
    )
    items = by_contender(trials, "turn")
    return Table.of("beyond", "Beyond Table I", "contender", items, columns, note)


def blind_table(trials: DataFrame) -> Table:
    """Turns with the camera off."""
    items: dict[str, DataFrame] = {}
    for name, found in by_contender(trials).items():
        for kind in _BLIND:
            mine = found[found["kind"] == kind]
            items[f"{name}, {kind}, all"] = mine
            if name == PLANNED:
                items |= _each("object", mine, f"{kind}, ")
    columns: dict[Column, Callable[[DataFrame], Cell]] = {
        Column("median error [deg]"): lambda mine: float(mine["true_error_deg"].median()),
        Column("largest error [deg]"): lambda mine: float(mine["true_error_deg"].max()),
        Column("error of the estimate, rms [deg]"): lambda mine: _rms(mine["estimate_error_deg"]),
        Column("stated sd [deg]"): lambda mine: _rms(mine["axis_std_deg"]),
        Column("90 % interval holds"): lambda mine: stats.rate(covered(mine)) if len(covered(mine)) else None,
        Column("looks", ".1f"): lambda mine: float(mine["looks"].mean()),
        Column("lost"): lambda mine: stats.rate(mine["lost"]),
    }
    items = {name: mine for name, mine in items.items() if len(mine)}
    note = (
        "The camera is off from the first reading on. True error about the axis at the end; error of the "
        "estimate and its stated standard deviation likewise. 'No touch': the prediction alone. "
        f"Single objects: {PLANNED}."
    )
    return Table.of("blind", "Whole turns with the camera off", "kind", items, columns, note)


def _each(column: str, turns: DataFrame, prefix: str = "") -> dict[str, DataFrame]:
    """Turns by the value of a column, under ``{prefix}{value}``."""
    return {f"{prefix}{value}": mine for value, mine in turns.groupby(column, sort=False)}


def _rms(values: Series) -> float | None:
    known = values.dropna().astype(float)
    return float(np.sqrt(known.pow(2).mean())) if len(known) else None


def _reach_plot(turns: DataFrame, folder: Path) -> list[FigureFile]:
    """Predicted against real ends of the E-KM's turns."""
    far = turns[(turns["kind"] == "far") & turns["reach_deg"].notna()]
    if far.empty:
        return []
    figure, (axis,) = new_figure(4.5, 4.2)
    predicted, real = far["reach_deg"].astype(float).abs(), far["largest_deg"]
    top = 5 + max(predicted.max(), real.max())
    axis.plot([0, top], [0, top], color=COLOURS["KM"], linewidth=1)
    for k, name in enumerate(far["object"].unique()):
        mine = far["object"] == name
        label = name.replace("_", " ")
        axis.plot(real[mine], predicted[mine], "osD^v*PX"[k % 8], label=label, markersize=5)
    axis.set(xlabel="real end [deg]", ylabel="predicted end [deg]", xlim=(0, top), ylim=(0, top))
    axis.legend(frameon=False, fontsize=8)
    caption = "Ends of the E-KM's turns, and the model's predictions before the first motion."
    return [save_figure(figure, folder, "reach", caption)]
