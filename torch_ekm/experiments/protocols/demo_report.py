"""Run the demo and leave a folder that shows what came of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ...description import load_hand, load_object
from ...rendering import make_scene, save_animation, save_picture
from ...simulation import PlantConfig, preset
from ..config import Setting, digest
from ..jobs import run_jobs
from ..reporting.metrics import Estimate, bootstrap_mean, compare_errors
from ..reporting.plots import plot_convergence, plot_prediction_error, plot_steady_state_error, save_figure
from ..reporting.report import FigureFile, Report, Table
from .demo import CONTROLLERS, DemoConfig, run_session

Record = dict[str, Any]
#: Seeds from here on are never used for tuning.
REPORTED = 1000


def run_demo(
    config: DemoConfig,
    folder: Path,
    processes: int = 1,
    on_done: Callable[[str], None] | None = None,
    pictures: bool = True,
) -> Report:
    """Run every seed with every controller, and write the report into ``folder``.

    Interrupted, it goes on where it stopped when it is called again with the same configuration;
    results of another configuration are set aside by their name.

    Args:
        processes: how many at once.
        on_done: called with each finished job's name (for progress bars).
        pictures: also draw the hand and the animation.
    """
    jobs = demo_jobs(config)
    results = run_jobs(run_session, jobs, folder / "runs", processes, on_done)
    records = [record for session in results.values() for record in session]
    overall, by_angle = summary_table(records), angle_table(records, config)
    figures = _figures(records, config, folder)
    if pictures:
        figures = _pictures(records, config, folder) + figures
    report = Report(
        title=f"Turning the {_spoken(config.object)} with the hand {_spoken(config.hand)}: KM and E-KM",
        summary=verdict(records),
        tables=[overall, by_angle],
        figures=figures,
        configuration={
            "demo": dataclasses.asdict(config),
            "plant": dataclasses.asdict(preset("nominal")),
            "plant_config": dataclasses.asdict(PlantConfig()),
        },
    )
    report.write(folder)
    return report


def demo_jobs(config: DemoConfig) -> dict[str, tuple[Any, ...]]:
    """One job for each seed and controller; the name holds all that decides its result."""
    setting = Setting(
        hand=config.hand,
        capacity=config.capacity,
        tolerance_deg=config.tolerance_deg,
        max_steps=config.max_steps,
    )
    own = digest(setting, (config.object,), dataclasses.replace(config, seeds=(0,)))
    stem = f"{Path(config.hand).stem}_{Path(config.object).stem}_{own}"
    return {f"{stem}_{name}_{seed}": (config, name, seed) for seed in config.seeds for name in CONTROLLERS}


def per_seed(records: list[Record], controller: str, value: Callable[[Record], list[float]]) -> np.ndarray:
    """Mean of ``value`` over each seed's trials: the independent units of the statistics."""
    seeds = sorted({record["seed"] for record in records})
    mine = [record for record in records if record["controller"] == controller]
    means = []
    for seed in seeds:
        values = [x for record in mine if record["seed"] == seed for x in value(record)]
        if values:
            means.append(float(np.mean(values)))
    return np.array(means)


def prediction_estimates(records: list[Record]) -> tuple[Estimate, Estimate]:
    """One-step prediction error of KM and E-KM on the same motions (those of the E-KM's runs) [deg]."""
    km = per_seed(records, "E-KM", lambda record: record["prediction_km_deg"])
    ekm = per_seed(records, "E-KM", lambda record: record["prediction_ekm_deg"])
    return bootstrap_mean(km), bootstrap_mean(ekm)


def verdict(records: list[Record]) -> str:
    """One sentence with the figures."""
    km, ekm = prediction_estimates(records)
    seeds = sorted({record["seed"] for record in records})
    tuned = "not used for tuning" if seeds[0] >= REPORTED else "development seeds: figures were tuned on them"
    grasps = (
        f"{len(seeds)} grasps (seeds {seeds[0]} to {seeds[-1]}"
        if len(seeds) > 1
        else f"one grasp (seed {seeds[0]}"
    )
    return (
        f"On {grasps}, {tuned}) the "
        f"one-step prediction error of the E-KM was {ekm.mean:.2f} deg, {100 * ekm.mean / km.mean:.0f} % of "
        f"the KM's {km.mean:.2f} deg on the same motions."
    )


def summary_table(records: list[Record]) -> Table:
    """All angles together, with 95 % bootstrap intervals over seeds."""
    km, ekm = prediction_estimates(records)
    own = bootstrap_mean(per_seed(records, "KM", lambda record: record["prediction_km_deg"]))
    rows = []
    for name in CONTROLLERS:
        mine = [record for record in records if record["controller"] == name]
        static = bootstrap_mean(per_seed(records, name, lambda record: [record["true_error_deg"]]))
        steps = bootstrap_mean(per_seed(records, name, lambda record: [record["steps"]]))
        off = bootstrap_mean(per_seed(records, name, lambda record: [record["off_rotation_deg"]]))
        seconds = np.concatenate([record["seconds"] for record in mine])
        rows.append(
            [
                name,
                _text(static),
                f"{np.median([record['true_error_deg'] for record in mine]):.2f}",
                _text(own) if name == "KM" else f"{_text(ekm)} (KM: {_text(km)})",
                _text(steps, 1),
                _text(off, 1),
                f"{sum(record['reason'] == 'reached' for record in mine)}/{len(mine)}",
                f"{sum(record['lost'] for record in mine)}/{len(mine)}",
                f"{1e3 * np.median(seconds):.1f}",
            ]
        )
    compared = (
        compare_errors(
            per_seed(records, "E-KM", lambda record: record["prediction_ekm_deg"]),
            per_seed(records, "E-KM", lambda record: record["prediction_km_deg"]),
        )
        if len({record["seed"] for record in records}) > 1
        else None
    )
    note = (
        "Mean and 95 % bootstrap interval over seeds; angles in degrees. Steady-state error is by the "
        "simulation's truth at the end of each trial, lost objects included. The prediction error of the "
        "E-KM stands beside the KM's on the same motions; the KM's own row is on its own motions."
    )
    if compared is not None:
        note += (
            f" Paired over seeds, E-KM minus KM: {compared.difference:.2f} deg "
            f"[{compared.low:.2f}, {compared.high:.2f}], p = {compared.paired_p:.1g}."
        )
    header = [
        "controller", "steady-state error", "median", "prediction error", "steps", "off-axis rotation",
        "reached", "lost", "ms per step",
    ]  # fmt: skip
    return Table("summary", "All angles", header, rows, note)


def angle_table(records: list[Record], config: DemoConfig) -> Table:
    """Each target on its own."""
    rows = []
    for angle in config.angles_deg:
        row = [f"{angle:g}"]
        for name in CONTROLLERS:
            mine = [r for r in records if r["controller"] == name and r["angle_deg"] == angle]
            row += [
                f"{np.mean([r['true_error_deg'] for r in mine]):.2f}",
                f"{np.mean([r['steps'] for r in mine]):.1f}",
                f"{sum(r['lost'] for r in mine)}",
            ]
        rows.append(row)
    header = ["target"] + [f"{name}: {what}" for name in CONTROLLERS for what in ("error", "steps", "lost")]
    return Table("by_angle", "Steady-state error, steps and lost objects for each target [deg]", header, rows)


def _figures(records: list[Record], config: DemoConfig, folder: Path) -> list[FigureFile]:
    sessions = [
        [record for record in records if record["controller"] == "E-KM" and record["seed"] == seed]
        for seed in config.seeds
    ]
    curves = {
        key: [np.concatenate([record[key] for record in session]) for session in sessions]
        for key in ("prediction_km_deg", "prediction_ekm_deg")
    }
    shortest = min(len(curve) for curve in curves["prediction_km_deg"])
    figures = []

    def add(figure: Any, name: str, caption: str) -> None:
        save_figure(figure, folder, name)
        figures.append(FigureFile(f"{name}.svg", caption))

    if shortest >= 5:
        km, ekm = (
            np.stack([_running_mean(curve[:shortest]) for curve in curves[key]])
            for key in ("prediction_km_deg", "prediction_ekm_deg")
        )
        add(
            plot_prediction_error(ekm, km, xlabel="motion"),
            "prediction_error",
            "One-step prediction error of KM and E-KM on the same motions, running mean over 5 motions; the "
            "learner starts empty at motion 1 (the paper's Fig. 5a).",
        )
    errors = {
        name: {
            f"{angle:g}": np.array(
                [r["true_error_deg"] for r in records if r["controller"] == name and r["angle_deg"] == angle]
            )
            for angle in config.angles_deg
        }
        for name in CONTROLLERS
    }
    add(
        plot_steady_state_error(errors),
        "steady_state_error",
        "Steady-state error for each target [deg] (the paper's Fig. 6).",
    )
    last = config.angles_deg[-1]
    histories = {
        name: [
            np.array(r["errors_deg"]) for r in records if r["controller"] == name and r["angle_deg"] == last
        ]
        for name in CONTROLLERS
    }
    add(
        plot_convergence(histories, f"{last:g} deg"),
        "convergence",
        f"Error on the way to {last:g} deg, as measured.",
    )
    return figures


def _pictures(records: list[Record], config: DemoConfig, folder: Path) -> list[FigureFile]:
    """The E-KM's best long turn: before and after, and as an animation."""
    turns = [r for r in records if r["controller"] == "E-KM" and not r["lost"]]
    if not turns:
        return []
    turn = max(turns, key=lambda r: (r["reason"] == "reached", r["angle_deg"], -r["true_error_deg"]))
    q, position, rotation = (np.array([frame[k] for frame in turn["frames"]]) for k in range(3))
    hand, obj = load_hand(config.hand), load_object(config.object)
    scene = make_scene(hand, obj, q, position, rotation, np.array(hand.gravity))
    save_picture(scene, folder / "hand.png", frames=(0, -1))
    save_animation(scene, folder / "animation.html")
    what = f"a turn of {turn['angle_deg']:g} deg (seed {turn['seed']})"
    caption = f"The {_spoken(config.object)} before and after {what}."
    return [
        FigureFile("hand.png", caption),
        FigureFile("animation.html", "The same turn, motion by motion: drag to look around."),
    ]


def _spoken(name: str) -> str:
    """A name, or the stem of a path, as words."""
    return Path(name).stem.replace("_", " ")


def _running_mean(values: np.ndarray, window: int = 5) -> np.ndarray:
    """Mean over the last ``window`` values (fewer at the start)."""
    total = np.cumsum(np.insert(values, 0, 0.0))
    end = np.arange(1, len(values) + 1)
    start = np.maximum(end - window, 0)
    return (total[end] - total[start]) / (end - start)


def _text(estimate: Estimate, digits: int = 2) -> str:
    return f"{estimate.mean:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"
