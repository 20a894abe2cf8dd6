"""The report on foresight: reach, turns beyond Table I, turns with the camera off."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from foresight_turn import ForesightTurn

from torch_ekm.control import StopReason
from torch_ekm.description import load_hand, load_object
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.records import Record
from torch_ekm.experiments.reporting import statistics as stats
from torch_ekm.experiments.reporting.plots import COLOURS, new_figure, save_figure
from torch_ekm.experiments.reporting.report import Cell, Column, FigureFile, Report, Table
from torch_ekm.experiments.reporting.tables import Target, targets_table, which_seeds
from torch_ekm.rendering import make_scene, save_animation

Turns = Sequence[ForesightTurn]
Results = Mapping[str, Sequence[Record]]

#: A target is declined where it lies this far beyond the predicted reach [deg].
BEYOND_DEG = 2.0
_NINETY = 1.645  # standard deviations on either side that hold 90 % of a Gaussian
ONE_STEP = "one-step E-KM"
_BLIND = "blind", "blind, looks again", "blind, no touch"
_FREE = "nothing"
_LEGEND = {
    ONE_STEP: "each motion is chosen for itself",
    "oracle": "each motion is chosen for itself, by the true model, pose and forces",
}


def turns_of(results: Results, **wanted: object) -> list[ForesightTurn]:
    """Turns of grasped objects with these entries."""
    found = (r for session in results.values() for r in session if isinstance(r, ForesightTurn))
    return [r for r in found if all(getattr(r, key) == value for key, value in wanted.items())]


def reach_errors(turns: Turns) -> np.ndarray:
    """Predicted end less the real one [deg], of turns that ended and of which an end was predicted."""
    ended = [r for r in turns if r.reach_deg is not None and r.reason != StopReason.REACHED.value]
    return np.array([abs(r.reach_deg or 0.0) - r.largest_deg for r in ended])


def declined(turn: ForesightTurn) -> bool:
    """The model said that the target is out of reach."""
    if turn.reach_deg is None or turn.reach_end == _FREE:
        return False
    return abs(turn.angle_deg) > abs(turn.reach_deg) + BEYOND_DEG


def covered(turns: Turns) -> list[bool]:
    """The error of the estimate lies within the stated 90 % interval."""
    return [
        abs(r.estimate_error_deg) <= _NINETY * r.axis_std_deg
        for r in turns
        if r.estimate_error_deg is not None and r.axis_std_deg is not None
    ]


def contenders_of(results: Results) -> list[str]:
    """In the order in which they appear, the one-step controller first."""
    names = dict.fromkeys(r.contender for r in turns_of(results))
    return sorted(names, key=lambda name: name != ONE_STEP)


def _same_grasps(results: Results, contender: str) -> np.ndarray:
    """Largest angles [deg] of a contender and of the one-step controller on each grasp, ``(n, 2)``."""
    ours, theirs = (
        {(r.object, r.seed): r.largest_deg for r in turns_of(results, kind="far", contender=name)}
        for name in (contender, ONE_STEP)
    )
    return np.array([(ours[unit], theirs[unit]) for unit in ours if unit in theirs]).reshape(-1, 2)


def paired_ratio(results: Results, contender: str) -> float | None:
    """Median of the largest angle over that of the one-step controller, on the same grasps."""
    ours, theirs = _same_grasps(results, contender).T
    turned = theirs > 1.0
    return float(np.median(ours[turned] / theirs[turned])) if turned.any() else None


def _agreement(results: Results, contender: str) -> Cell:
    """How often a contender's turn ends within 2 deg of the one-step controller's."""
    if contender == ONE_STEP:
        return None
    return stats.rate((np.abs(np.diff(_same_grasps(results, contender))) <= 2).ravel().tolist())


def foresight_targets(results: Results) -> list[Target]:
    """What was aimed at."""
    found: list[Target] = []
    errors = reach_errors(turns_of(results, kind="far", contender=ONE_STEP))
    if errors.size:
        within = 100 * float(np.mean(np.abs(errors) <= 2))
        found.append(Target("reach predicted within 2 deg [% of grasps]", within, least=90))
    blind = turns_of(results, kind="blind", contender=ONE_STEP)
    if blind:
        median = float(np.median([r.true_error_deg for r in blind]))
        found.append(Target("blind turn with touch, median error [deg]", median, most=0.5))
        found.append(Target("its 90 % interval holds [%]", 100 * float(np.mean(covered(blind))), least=90))
    return found


def foresight_report(setting: Setting, seeds: Sequence[int], results: Results, folder: Path) -> Report:
    """The answer, the tables, two figures and an animation."""
    found = foresight_targets(results)
    tables = [
        far_table(results),
        reach_table(results),
        beyond_table(results),
        blind_table(results),
        targets_table(found) if found else None,
    ]
    figures = [
        *_reach_plot(results, folder),
        *_blind_plot(results, folder),
        *_animation(setting, results, folder),
    ]
    shown = [table for table in tables if table is not None and table.rows]
    title = "Foresight: how far, and what ends it; turns with the camera off"
    ends = [f"{name} {_ends(turns_of(results, contender=name))}" for name in contenders_of(results)]
    summary = f"{_answer(results)} Objects lost: {', '.join(ends)}. {which_seeds(seeds)}"
    legend = {name: line for name, line in _LEGEND.items() if name in contenders_of(results)}
    return Report(title, summary, shown, figures, legend=legend)


def _ends(turns: Turns) -> str:
    beyond = [r for r in turns if r.kind == "turn"]
    missed = (
        f" ({sum(r.not_reached for r in beyond)} of {len(beyond)} beyond Table I not reached)"
        if beyond
        else ""
    )
    return f"{sum(r.lost for r in turns)} of {len(turns)} turns{missed}"


def _answer(results: Results) -> str:
    parts = []
    errors = np.abs(reach_errors(turns_of(results, kind="far", contender=ONE_STEP)))
    if errors.size:
        share = 100 * np.mean(errors <= 2)
        parts.append(
            f"The end of a turn is predicted to {np.median(errors):.1f} deg (median), within 2 deg in "
            f"{share:.0f} % of {errors.size} grasps."
        )
    blind = turns_of(results, kind="blind", contender=ONE_STEP)
    if blind:
        middle = np.median([r.true_error_deg for r in blind])
        hold = 100 * np.mean(covered(blind))
        parts.append(
            f"A blind turn of {blind[0].angle_deg:g} deg ends {middle:.2f} deg off (median of {len(blind)}); "
            f"the stated 90 % interval holds {hold:.0f} % of the estimates."
        )
    for name in contenders_of(results):
        ratio = paired_ratio(results, name)
        if name != ONE_STEP and ratio is not None:
            parts.append(f"{name} turns {ratio:.2f} times as far as the one-step E-KM (median).")
    return " ".join(parts) or "Nothing was grasped."


def far_table(results: Results) -> Table:
    """The largest angle of each contender."""
    items = {name: turns_of(results, kind="far", contender=name) for name in contenders_of(results)}
    columns: dict[Column, Callable[[Turns], Cell]] = {
        Column("largest angle [deg]", ".1f"): lambda mine: stats.bootstrap_mean(
            np.array([r.largest_deg for r in mine])
        ),
        Column("median [deg]", ".1f"): lambda mine: float(np.median([r.largest_deg for r in mine])),
        Column(f"paired, {ONE_STEP} = 1"): lambda mine: paired_ratio(results, mine[0].contender),
        Column(f"within 2 deg of {ONE_STEP}"): lambda mine: _agreement(results, mine[0].contender),
        Column("not reached"): lambda mine: stats.rate(r.not_reached for r in mine),
        Column("lost"): lambda mine: stats.rate(r.lost for r in mine),
    }
    note = (
        "The target is farther than any grasp goes; the largest true angle before the turn ended. How "
        "often two controllers end within 2 deg of each other on the same grasp bounds what can be predicted."
    )
    items = {name: mine for name, mine in items.items() if mine}
    return Table.of("far", "As far as it goes", "contender", items, columns, note)


def reach_table(results: Results) -> Table:
    """How well the end was predicted; of the one-step controller for each object and how the turn ended."""
    far = [r for r in turns_of(results, kind="far") if r.reach_deg is not None]
    items: dict[str, Turns] = {}
    for name in contenders_of(results):
        mine = [r for r in far if r.contender == name]
        items[f"{name}, all"] = mine
        if name == ONE_STEP:
            items |= _each("object", mine) | _each("reason", mine)
    columns: dict[Column, Callable[[Turns], Cell]] = {
        Column("grasps"): lambda mine: len(reach_errors(mine)),
        Column("median absolute error [deg]", ".1f"): lambda mine: float(
            np.median(np.abs(reach_errors(mine)))
        ),
        Column("mean error [deg]", "+.1f"): lambda mine: float(reach_errors(mine).mean()),
        Column("within 2 deg"): lambda mine: stats.rate((np.abs(reach_errors(mine)) <= 2).tolist()),
        Column("within 5 deg"): lambda mine: stats.rate((np.abs(reach_errors(mine)) <= 5).tolist()),
        Column("ends by (predicted)"): lambda mine: _most(r.reach_end for r in mine),
    }
    items = {name: mine for name, mine in items.items() if len(reach_errors(mine))}
    note = (
        f"Predicted less real largest angle. Of the {ONE_STEP} also for each object and, below, by how the "
        "turn really ended."
    )
    return Table.of("reach", "Predicted ends of turns", "turns", items, columns, note)


def beyond_table(results: Results) -> Table:
    """Turns beyond Table I, and what declining would have spared."""
    items = {name: turns_of(results, kind="turn", contender=name) for name in contenders_of(results)}
    columns: dict[Column, Callable[[Turns], Cell]] = {
        Column("turns"): len,
        Column("reached"): lambda mine: stats.rate(r.reason == StopReason.REACHED.value for r in mine),
        Column("not reached"): lambda mine: stats.rate(r.not_reached for r in mine),
        Column("lost"): lambda mine: stats.rate(r.lost for r in mine),
        Column("declined"): lambda mine: sum(declined(r) for r in mine),
        Column("of these lost or not reached"): lambda mine: sum(
            r.lost or r.not_reached for r in mine if declined(r)
        ),
        Column("lost, not declined"): lambda mine: sum(r.lost for r in mine if not declined(r)),
    }
    note = (
        f"Declined: more than {BEYOND_DEG:g} deg beyond the predicted reach. These turns were made all the "
        "same, to see what declining them would have spared."
    )
    items = {name: mine for name, mine in items.items() if mine}
    return Table.of("beyond", "Beyond Table I", "contender", items, columns, note)


def blind_table(results: Results) -> Table:
    """Turns with the camera off."""
    items: dict[str, Turns] = {}
    for name in contenders_of(results):
        for kind in _BLIND:
            mine = turns_of(results, kind=kind, contender=name)
            items[f"{name}, {kind}, all"] = mine
            if name == ONE_STEP:
                items |= _each("object", mine, f"{kind}, ")
    columns: dict[Column, Callable[[Turns], Cell]] = {
        Column("median error [deg]"): lambda mine: float(np.median([r.true_error_deg for r in mine])),
        Column("largest error [deg]"): lambda mine: float(max(r.true_error_deg for r in mine)),
        Column("error of the estimate, rms [deg]"): lambda mine: _rms([r.estimate_error_deg for r in mine]),
        Column("stated sd [deg]"): lambda mine: _rms([r.axis_std_deg for r in mine]),
        Column("90 % interval holds"): lambda mine: stats.rate(covered(mine)) if covered(mine) else None,
        Column("looks", ".1f"): lambda mine: float(np.mean([r.looks for r in mine])),
        Column("lost"): lambda mine: stats.rate(r.lost for r in mine),
    }
    items = {name: mine for name, mine in items.items() if mine}
    note = (
        "The camera is off from the first reading on. True error about the axis at the end; error of the "
        "estimate and its stated standard deviation likewise. 'No touch': the prediction alone. "
        f"Single objects: {ONE_STEP}."
    )
    return Table.of("blind", "Whole turns with the camera off", "kind", items, columns, note)


def _each(entry: str, turns: Turns, prefix: str = "") -> dict[str, Turns]:
    """Turns by the value of an entry, under ``{prefix}{value}``."""
    values = dict.fromkeys(str(getattr(r, entry)) for r in turns)
    return {f"{prefix}{value}": [r for r in turns if getattr(r, entry) == value] for value in values}


def _most(names) -> str:
    found = list(names)
    return max(set(found), key=lambda name: (found.count(name), name)) if found else ""


def _rms(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known else None


def _reach_plot(results: Results, folder: Path) -> list[FigureFile]:
    """Predicted against real ends."""
    far = [r for r in turns_of(results, kind="far", contender=ONE_STEP) if r.reach_deg is not None]
    if not far:
        return []
    figure, (axis,) = new_figure(4.5, 4.2)
    top = 5 + max(max(abs(r.reach_deg or 0.0), r.largest_deg) for r in far)
    axis.plot([0, top], [0, top], color=COLOURS["KM"], linewidth=1)
    for k, name in enumerate(dict.fromkeys(r.object for r in far)):
        mine = [r for r in far if r.object == name]
        x, y = [r.largest_deg for r in mine], [abs(r.reach_deg or 0.0) for r in mine]
        axis.plot(x, y, "osD^v*PX"[k % 8], label=name.replace("_", " "), markersize=5)
    axis.set(xlabel="real end [deg]", ylabel="predicted end [deg]", xlim=(0, top), ylim=(0, top))
    axis.legend(frameon=False, fontsize=8)
    caption = "Where the one-step E-KM's turns ended, and where the model said before anything moved."
    return [save_figure(figure, folder, "reach", caption)]


def _blind_plot(results: Results, folder: Path) -> list[FigureFile]:
    """Errors of turns with the camera off, by contender."""
    blind = [r for r in turns_of(results) if r.kind in _BLIND and not r.lost]
    names = [name for name in contenders_of(results) if any(r.contender == name for r in blind)]
    if not blind:
        return []
    figure, (axis,) = new_figure(5.0, 3.2)
    width = 0.8 / len(names)
    for j, name in enumerate(names):
        for k, kind in enumerate(_BLIND):
            errors = sorted(r.true_error_deg for r in blind if (r.contender, r.kind) == (name, kind))
            middle = k + (j - (len(names) - 1) / 2) * width
            places = middle + width * np.linspace(-0.3, 0.3, len(errors))
            axis.plot(places, errors, "o", color=f"C{j}", markersize=2.5, label=None if k else name)
            if errors:
                axis.plot(middle + width * np.array([-0.4, 0.4]), [np.median(errors)] * 2, color="black")
    axis.set_xticks(range(len(_BLIND)), list(_BLIND))
    axis.set(ylabel="true error [deg]", ylim=(0, None))
    axis.legend(frameon=False, fontsize=8, markerscale=2)
    caption = "Whole turns with the camera off, without lost ones: each turn, in order, and the median."
    return [save_figure(figure, folder, "blind", caption)]


def _animation(setting: Setting, results: Results, folder: Path) -> list[FigureFile]:
    """The farthest turn that was predicted, with the predicted object as a ghost."""
    turns = [r for r in turns_of(results, kind="far") if r.poses and r.predicted and not r.lost]
    if not turns:
        return []
    turn = max(turns, key=lambda r: r.largest_deg)
    hand, obj = load_hand(setting.hand), load_object(turn.object)
    n = len(turn.poses)
    predicted = [turn.predicted[min(k, len(turn.predicted) - 1)] for k in range(n)]
    q, position, rotation = (np.array(part) for part in zip(*turn.poses, strict=True))
    _, ghost_position, ghost_rotation = (np.array(part) for part in zip(*predicted, strict=True))
    scene = make_scene(
        hand, obj, q, position, rotation, np.array(hand.gravity), ghost=(ghost_position, ghost_rotation)
    )
    save_animation(scene, folder / "animation.html")
    what = f"{turn.object.replace('_', ' ')}, {turn.contender}, seed {turn.seed}"
    return [
        FigureFile("animation.html", f"As far as it goes ({what}); see-through: as the model predicted it.")
    ]
