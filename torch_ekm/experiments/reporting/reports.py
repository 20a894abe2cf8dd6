"""The report of each experiment: summary, tables and figures from the results of its jobs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..config import CONTROLLERS
from ..protocols.ablation import AblationConfig, ablation_tables
from ..protocols.demo_report import REPORTED
from ..protocols.object_memory import MEMORIES, AdaptConfig, judge_assignment
from ..protocols.turning import GeneralizeConfig, OnlineConfig, object_name
from .learning_tables import learning_table, prediction_curves, prediction_table
from .memory_tables import memory_comparison
from .metrics import bootstrap_mean
from .plots import plot_bank, plot_learning_test, plot_prediction_error, plot_steady_state_error, save_figure
from .report import FigureFile, Report, Table
from .statistics import (
    Record,
    bootstrap_ratio,
    mean_prediction,
    paired_means,
    rate,
    select,
    steady_state_error,
)
from .tables import (
    comparison_table,
    controller_table,
    object_table,
    percent,
    probe_table,
    reason_table,
    text,
    timing_table,
)
from .targets import adapt_targets, generalize_targets, online_targets, targets_table

Results = Mapping[str, Any]


def online_report(config: OnlineConfig, seeds: tuple[int, ...], results: Results, folder: Path) -> Report:
    """Online manipulation: Fig. 5a and 5b, and every controller's turns."""
    records = _all(results)
    limit, trials, events = config.setting.max_steps, config.trials, config.events
    curves = prediction_curves(records, trials)
    figures = []
    ekm, km = (np.stack([curve[i] for curve in curves.values()]) for i in (0, 1))
    some = np.isfinite(ekm).any(axis=0)
    if some.sum() > 1:
        save_figure(plot_prediction_error(ekm[:, some], km[:, some]), _made(folder), "prediction_error")
        caption = f"One-step prediction error in each trial (Fig. 5a). Events in trials {_listed(events)}."
        figures.append(FigureFile("prediction_error.svg", caption))
        first = next(iter(curves))
        both = np.isfinite(curves[first][0])
        if both.sum() > 1:
            figure = plot_learning_test(curves[first][0][both], curves[first][1][both])
            save_figure(figure, folder, "learning_test")
            caption = f"p(k) and b(k) of the first k trials, seed {first} (Fig. 5b)."
            figures.append(FigureFile("learning_test.svg", caption))
    tables = [
        targets_table(online_targets(records, events, trials)),
        learning_table(records, events, trials),
        learning_table(records, events, trials, against_truth=True),
        prediction_table(records),
        controller_table(records, limit),
        comparison_table(records, limit),
        reason_table(records),
        timing_table(records),
    ]
    summary = f"{trials} turns of the {object_name(config.object)}. {_verdict(records, seeds)}"
    return Report("Online manipulation: learning while turning", summary, tables, figures)


def generalize_report(
    config: GeneralizeConfig, seeds: tuple[int, ...], results: Results, folder: Path
) -> Report:
    """Generalisation: Tables I and II, Fig. 6, and the probes."""
    records = _all(results)
    limit = config.setting.max_steps
    figures = []
    for item in config.objects:
        name = object_name(item)
        turns = [r for r in records if r["object"] == name and r["kind"] == "turn" and r["grasped"]]
        if not turns:
            continue
        errors = {
            controller: {
                f"{angle:g}": np.array(
                    [
                        steady_state_error(r)
                        for r in turns
                        if r["controller"] == controller and r["angle_deg"] == angle
                    ]
                )
                for angle in config.angles_of(item)
            }
            for controller in CONTROLLERS
        }
        save_figure(
            plot_steady_state_error(errors, name.replace("_", " ")),
            _made(folder),
            f"steady_state_error_{name}",
        )
        figures.append(
            FigureFile(
                f"steady_state_error_{name}.svg",
                f"Steady-state error with the {name} (Fig. 6). Crosses: lost objects, off the scale.",
            )
        )
    tables = [
        targets_table(generalize_targets(records, limit)),
        angles_table(config),
        object_table(records),
        controller_table(records, limit),
        comparison_table(records, limit),
        probe_table(records),
        prediction_table(records),
        reason_table(records),
        timing_table(records),
    ]
    names = ", ".join(object_name(item) for item in config.objects)
    summary = f"Objects: {names}. {_verdict(records, seeds)}"
    return Report("Generalisation: other objects, other weights", summary, tables, figures)


def ablation_report(config: AblationConfig, seeds: tuple[int, ...], results: Results, folder: Path) -> Report:
    """One table for each kind of change."""
    tables = ablation_tables(config, seeds, results)
    summary = f"One change at a time, {object_name(config.object)}. {_which(seeds)}"
    return Report("Ablations: what each part is worth", summary, tables)


def adapt_report(config: AdaptConfig, seeds: tuple[int, ...], results: Results, folder: Path) -> Report:
    """Object memory: who is recognised, and what it is worth."""
    sessions = [list(result) for result in results.values()]
    rows = []
    for name in ("none", *MEMORIES):
        means = np.array([_mean_error(s, name) for s in sessions])
        first = [e[:5] for s in sessions for r in s if (e := r["memory_errors_deg"][name])]
        rows.append([name, text(bootstrap_mean(means), 3), f"{np.mean(np.concatenate(first)):.3f}"])
    note = (
        "Mean over all motions [deg], 95 % bootstrap interval over sequences; and over the first five "
        "motions of each turn. All memories see the same motions, those that the bank's E-KM chose; "
        "'none' is the KM."
    )
    memories = Table("memories", "One-step prediction error", ["memory", "all", "first motions"], rows, note)
    figures = []
    if sessions and sessions[0]:
        save_figure(plot_bank(sessions[0]), _made(folder), "bank")
        figures.append(FigureFile("bank.svg", f"Where the bank put each turn, seed {seeds[0]}."))
    tables = [
        targets_table(adapt_targets(sessions)),
        memories,
        memory_comparison(sessions),
        _assignments(sessions, seeds),
    ]
    lost = rate(r["lost"] for s in sessions for r in s)
    summary = (
        f"{len(config.objects)} objects in random order, {config.turns_each} turns each, without labels; "
        f"objects lost: {lost}. {_which(seeds)}"
    )
    return Report("Object memory: familiar objects and new ones", summary, tables, figures)


def angles_table(config: GeneralizeConfig) -> Table:
    """The rotations that were asked for (Table I)."""
    angles = {object_name(item): config.angles_of(item) for item in config.objects}
    longest = max(len(values) for values in angles.values())
    rows = [
        [str(k + 1), *(f"{values[k]:g}" if k < len(values) else "-" for values in angles.values())]
        for k in range(longest)
    ]
    return Table("angles", "Rotations [deg] (Table I)", ["trial", *angles], rows)


def _assignments(sessions: list[list[Record]], seeds: tuple[int, ...]) -> Table:
    rows = []
    for seed, records in zip(seeds, sessions, strict=True):
        judged = judge_assignment(records)
        rows.append([str(seed), f"{judged.right}/{judged.judged}", str(judged.n_models)])
    note = "Turns after the first three of their object; a model belongs to the object of most of its turns."
    return Table("assignments", "Recognised objects", ["seed", "right", "models"], rows, note)


def _verdict(records: list[Record], seeds: tuple[int, ...]) -> str:
    ours, theirs = paired_means(
        select(records, controller="E-KM", kind="turn"),
        select(records, controller="KM", kind="turn"),
        steady_state_error,
    )
    mine = [r for r in select(records, controller="E-KM", kind="turn") if r["prediction_ekm_deg"]]
    parts = []
    if len(ours) and theirs.mean() > 0:
        parts.append(f"Steady-state error E-KM : KM {percent(bootstrap_ratio(ours, theirs))} %")
    if mine:
        ours, theirs = paired_means(mine, mine, mean_prediction("ekm"), mean_prediction("km"))
        parts.append(f"prediction error on the same motions {percent(bootstrap_ratio(ours, theirs))} %")
    parts += _never_grasped(records)
    return "; ".join(parts or ["Nothing to compare"]) + f". {_which(seeds)}"


def _never_grasped(records: list[Record]) -> list[str]:
    """A sentence on each object that no trial could hold, with the reason of the last try."""
    turns = [r for r in records if r["kind"] == "turn"]
    held = {r["object"] for r in turns if r["grasped"]}
    why = {r["object"]: r.get("message", "") for r in turns if r["object"] not in held}
    return [f"{name} was never grasped ({reason})" for name, reason in why.items()]


def _which(seeds: Sequence[int]) -> str:
    few = " Fewer than 20 seeds: no basis for a claim." if len(seeds) < 20 else ""
    tuned = " Development seeds: figures may have been tuned on them." if min(seeds) < REPORTED else ""
    return f"{len(seeds)} seeds, {seeds[0]} to {seeds[-1]}.{few}{tuned}"


def _all(results: Results) -> list[Record]:
    return [record for session in results.values() for record in session]


def _mean_error(records: list[Record], memory: str) -> float:
    return float(np.mean([e for r in records for e in r["memory_errors_deg"][memory]]))


def _listed(events: tuple[int, ...]) -> str:
    return ", ".join(str(event) for event in events) or "none"


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
