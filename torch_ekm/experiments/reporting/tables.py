"""Tables of the experiments: what each controller did, who was better, and by how much."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..config import CONTROLLERS
from .metrics import Estimate, bootstrap_mean
from .report import Table
from .statistics import (
    BAND_DEG,
    Record,
    Value,
    bootstrap_ratio,
    compare,
    paired_means,
    rate,
    select,
    settle_steps,
    steady_state_error,
    survivor_error,
    unit_means,
)

Array = NDArray[np.float64]

STATIC_NOTE = (
    "Mean and 95 % bootstrap interval over seeds; angles in degrees, steady-state errors by the simulation's "
    "truth. A lost object counts with the whole angle that was asked for; 'survivors' leaves it out. "
    f"Settled: the measured error stays within {BAND_DEG:g} deg; a turn that never settles counts with the "
    "step limit. Intervals of rates are Wilson's."
)
_REASONS = (
    "reached",
    "stalled",
    "step limit",
    "actuator limits",
    "unstable grasp",
    "object lost",
    "not grasped",
)


def text(estimate: Estimate | None, digits: int = 2) -> str:
    """``mean [low, high]``."""
    if estimate is None:
        return "-"
    return f"{estimate.mean:.{digits}f} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def estimate(records: list[Record], value: Value) -> Estimate | None:
    """Mean of a value over ``(object, seed)`` units."""
    means = np.array(list(unit_means(records, value).values()))
    return bootstrap_mean(means) if means.size else None


def controller_table(records: list[Record], limit: int) -> Table:
    """Every controller on the same seeds and grasps."""
    rows = []
    for name in CONTROLLERS:
        mine = select(records, controller=name, kind="turn")
        if not mine:
            continue
        rows.append(
            [
                name,
                text(estimate(mine, steady_state_error)),
                text(estimate(mine, survivor_error)),
                f"{np.median([steady_state_error(r) for r in mine]):.2f}",
                text(estimate(mine, lambda r: settle_steps(r, limit=limit)), 1),
                text(estimate(mine, lambda r: r["first_step_deg"])),
                text(estimate(mine, lambda r: r["step_error_deg"])),
                text(estimate(mine, lambda r: None if r["lost"] else r["off_rotation_deg"]), 1),
                str(rate(r["lost"] for r in mine)),
            ]
        )
    header = [
        "controller", "steady-state error", "survivors", "median", "motions to settle", "first motion",
        "of all motions", "off-axis rotation", "lost",
    ]  # fmt: skip
    return Table("controllers", "All turns of each controller", header, rows, STATIC_NOTE)


def reason_table(records: list[Record]) -> Table:
    """Why the controllers stopped, with the steady-state error of each kind."""
    rows = []
    for name in CONTROLLERS:
        mine = [r for r in records if r["controller"] == name and r["kind"] == "turn"]
        if not mine:
            continue
        row = [name]
        for reason in _REASONS:
            those = [r for r in mine if r["reason"] == reason]
            cell = str(len(those))
            if those and reason not in ("object lost", "not grasped"):
                cell += f" ({np.mean([r['true_error_deg'] for r in those]):.2f})"
            row.append(cell)
        rows.append(row)
    note = "Number of turns, and their mean true error [deg]."
    return Table("stop_reasons", "Why the controllers stopped", ["controller", *_REASONS], rows, note)


def object_table(records: list[Record]) -> Table:
    """Steady-state error of each object, paired (the paper's Table II)."""
    rows = []
    objects = list(dict.fromkeys(r["object"] for r in records))
    for item in [*objects, None]:
        chosen = [r for r in records if item is None or r["object"] == item]
        by = {name: select(chosen, controller=name, kind="turn") for name in CONTROLLERS}
        if not by["KM"] or not by["E-KM"]:
            continue
        ours, theirs = paired_means(by["E-KM"], by["KM"], steady_state_error)
        tests = compare(ours, theirs)
        rows.append(
            [
                item or "all",
                *(text(estimate(by[name], steady_state_error)) for name in CONTROLLERS),
                percent(bootstrap_ratio(ours, theirs)),
                "-" if tests is None else f"{tests.welch_p:.1g} / {tests.paired_p:.1g}",
                "-" if tests is None else f"{tests.effect_size:.1f}",
                *(str(sum(r["lost"] for r in by[name])) for name in CONTROLLERS),
            ]
        )
    header = [
        "object", *(f"{name} [deg]" for name in CONTROLLERS), "E-KM:KM [%]", "p Welch / paired", "effect",
        *(f"{name} lost" for name in CONTROLLERS),
    ]  # fmt: skip
    note = (
        "Steady-state error, lost objects with the whole angle. Ratio of means with the bootstrap over "
        "paired seeds; the effect size is Cohen's d of the paired differences. The paper's ratios: "
        "28.5 to 70 %, p = 3.8e-4."
    )
    return Table("by_object", "Steady-state error of each object (Table II)", header, rows, note)


def comparison_table(records: list[Record], limit: int) -> Table:
    """E-KM against KM and KM+I in everything that is measured."""
    values: list[tuple[str, Value]] = [
        ("steady-state error", steady_state_error),
        ("motions to settle", lambda r: settle_steps(r, limit=limit)),
        ("error of the first motion", lambda r: r["first_step_deg"]),
        ("error of all motions", lambda r: r["step_error_deg"]),
        ("off-axis rotation", lambda r: None if r["lost"] else r["off_rotation_deg"]),
    ]
    rows = []
    pairs = (("E-KM", "KM"), ("E-KM", "KM+I"), ("E-KM+I", "KM+I"))
    for what, value in values:
        row = [what]
        for ours_name, theirs_name in pairs:
            ours, theirs = paired_means(
                select(records, controller=ours_name, kind="turn"),
                select(records, controller=theirs_name, kind="turn"),
                value,
            )
            row.append(_ratio_cell(ours, theirs))
        rows.append(row)
    for kind, value in (("long step", _long_step_error), ("camera off", steady_state_error)):
        if not any(r["kind"] == kind for r in records):
            continue
        row = [{"long step": "error of one long step", "camera off": "steady-state error, camera off"}[kind]]
        for ours_name, theirs_name in pairs:
            ours, theirs = paired_means(
                select(records, controller=ours_name, kind=kind),
                select(records, controller=theirs_name, kind=kind),
                value,
            )
            row.append(_ratio_cell(ours, theirs))
        rows.append(row)
    header = ["", *(f"{ours} : {theirs} [%]" for ours, theirs in pairs)]
    note = (
        "Ratio of means over the same objects and seeds, 95 % bootstrap over pairs, p of the paired t-test."
    )
    return Table("comparison", "Paired ratios", header, rows, note)


def probe_table(records: list[Record]) -> Table:
    """What the model is worth without feedback: one long step, and turns that end in the dark."""
    rows = []
    for name in CONTROLLERS:
        steps = select(records, controller=name, kind="long step")
        dark = select(records, controller=name, kind="camera off")
        if not steps and not dark:
            continue
        rows.append(
            [
                name,
                text(estimate(steps, _long_step_error)),
                str(rate(r["lost"] for r in steps)),
                text(estimate(dark, steady_state_error)),
                str(rate(r["lost"] for r in dark)),
            ]
        )
    header = ["controller", "one long step", "lost", "camera off at the end", "lost"]
    return Table("probes", "True error without feedback [deg]", header, rows)


def timing_table(records: list[Record]) -> Table:
    """Decision and training, without plant and camera."""
    rows = []
    for name in CONTROLLERS:
        mine = select(records, controller=name, kind="turn")
        seconds = 1e3 * np.array([s for r in mine for s in r["seconds"]])
        if seconds.size:
            rows.append(
                [name, *(f"{x:.1f}" for x in np.percentile(seconds, [50, 90, 99])), str(seconds.size)]
            )
    header = ["controller", "median [ms]", "90 % [ms]", "99 % [ms]", "motions"]
    note = "Wall-clock time on the machine that ran the report, with whatever else it was doing."
    return Table("timing", "Time of one control step", header, rows, note)


def _long_step_error(record: Record) -> float:
    return abs(record["angle_deg"]) if record["lost"] else record["error_deg"]


def percent(ratio: Estimate) -> str:
    """The same in percent."""
    return f"{100 * ratio.mean:.0f} [{100 * ratio.low:.0f}, {100 * ratio.high:.0f}]"


def _ratio_cell(ours: Array, theirs: Array) -> str:
    if not len(ours) or theirs.mean() == 0:
        return "-"
    tests = compare(ours, theirs)
    return percent(bootstrap_ratio(ours, theirs)) + ("" if tests is None else f", p = {tests.paired_p:.1g}")
