"""What the reports of several protocols share: tables of the controllers, targets, sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...control import LimitingFunction, StopReason
from ...control.qp import DEGREE
from ..config import CONTROLLERS, FIRST_REPORTED
from ..records import NotGrasped, Record, TrialRecord
from . import statistics as stats
from .report import Cell, Column, Table
from .statistics import BAND_DEG, LEAST_SEEDS, Array, Estimate, Value, bootstrap_ratio, steady_state_error

Trials = Sequence[TrialRecord]

_PAIRS = (("E-KM", "KM"), ("E-KM", "KM+I"), ("E-KM", "KM+S"))
#: What each controller is, in a line.
LEGEND = {
    "KM": "the kinematic model alone; increments are added to what the encoders read",
    "KM+I": "the same model with integral action: increments add up on the set-point; it learns nothing",
    "KM+S": "the same model on the servo inverse, which finds the dead zones of the motors on the encoders",
    "E-KM": "the kinematic model and what was learned of its errors, on the same servo inverse",
}
_MEANINGS = {
    StopReason.REACHED: "the measured error stays within the tolerance",
    StopReason.STALLED: "the error falls no further",
    StopReason.STEP_LIMIT: "all motions are used up",
    StopReason.ACTUATOR_LIMITS: "the motors that are needed are at the ends of their ranges",
    StopReason.UNSTABLE_GRASP: "the model says that the grasp is about to buckle",
    StopReason.GIVEN_UP: "the grasp came too near to a loss, and the way back did not help",
    StopReason.OUT_OF_REACH: "declined before anything moved",
    StopReason.OBJECT_LOST: "the object was dropped, or turned off the axis beyond help",
    StopReason.FORCE_CEILING: "a fingertip pressed harder than the guard allows",
}


@dataclass(frozen=True)
class Target:
    """What was aimed at, and what was measured."""

    what: str
    """With its unit."""
    measured: float
    most: float | None = None
    least: float | None = None

    @property
    def missed_by(self) -> float:
        """0 if it is met."""
        above = 0.0 if self.most is None else self.measured - self.most
        below = 0.0 if self.least is None else self.least - self.measured
        return max(above, below, 0.0)


def targets_table(targets: Sequence[Target]) -> Table:
    """Each target: met, or by how much not."""
    columns: dict[Column, Callable[[Target], Cell]] = {
        Column("at least", "g"): lambda target: target.least,
        Column("at most", "g"): lambda target: target.most,
        Column("measured", ".3g"): lambda target: target.measured,
        Column("met"): lambda target: target.missed_by == 0,
        Column("missed by", ".3g"): lambda target: target.missed_by or None,
    }
    note = "Targets were set before the figures were known."
    return Table.of("targets", "Targets", "target", {t.what: t for t in targets}, columns, note)


def by_controller(records: Sequence[Record], kind: str = "turn") -> dict[str, list[TrialRecord]]:
    """Trials of one kind, of each controller that has any."""
    found = {name: stats.select(records, controller=name, kind=kind) for name in CONTROLLERS}
    return {name: mine for name, mine in found.items() if mine}


def legend(records: Sequence[Record]) -> dict[str, str]:
    """What the controllers are that took part."""
    there = {r.controller for r in records}
    return {name: line for name, line in LEGEND.items() if name in there}


def controller_table(records: Sequence[Record]) -> Table:
    """How the turns of every controller ended, on the same seeds and grasps."""
    columns: dict[Column, Callable[[Trials], Cell]] = {
        Column("steady-state error [deg]"): lambda mine: stats.estimate(mine, steady_state_error),
        Column("survivors [deg]"): lambda mine: stats.estimate(mine, stats.survivor_error),
        Column("median [deg]"): lambda mine: float(np.median([steady_state_error(r) for r in mine])),
        Column("reached"): lambda mine: stats.rate(r.reason == StopReason.REACHED.value for r in mine),
        Column("not reached"): lambda mine: stats.rate(r.not_reached for r in mine),
        Column("lost"): lambda mine: stats.rate(r.lost for r in mine),
    }
    note = (
        "Mean and 95 % bootstrap interval over pairs of object and seed; steady-state errors by the "
        "simulation's truth. A lost object counts with the whole angle that was asked for; 'survivors' "
        "leaves it out. Not reached: the object is in the hand, but not where it was to be. Intervals of "
        "rates are Wilson's."
    )
    items = by_controller(records)
    return Table.of("controllers", "All turns of each controller", "controller", items, columns, note)


def motion_table(records: Sequence[Record], limit: int) -> Table:
    """What the motions of every controller were worth."""
    step = LimitingFunction().step / DEGREE
    beyond = stats.beyond_least(limit, step)
    columns: dict[Column, Callable[[Trials], Cell]] = {
        Column("motions", ".1f"): lambda mine: stats.estimate(mine, lambda r: r.steps),
        Column("beyond angle / step", ".1f"): lambda mine: stats.estimate(mine, beyond),
        Column("first motion [deg]"): lambda mine: stats.estimate(mine, lambda r: r.first_step_deg),
        Column("all motions [deg]"): lambda mine: stats.estimate(mine, lambda r: r.step_error_deg),
        Column("off the axis [deg]", ".1f"): lambda mine: stats.estimate(mine, survivors_off_axis),
    }
    note = (
        "Mean and 95 % bootstrap interval over pairs of object and seed. Beyond angle / step: motions until "
        f"the measured error stays within {BAND_DEG:g} deg, less the angle over {step:g} deg, rounded up; "
        "below 0 where the pace is above 1. A turn that never settles counts with the limit. First motion, "
        "all motions: by how much more or less a motion changed the error than it was to. Off the axis: "
        "rotation at the end, of objects that were not lost."
    )
    return Table.of(
        "motions", "The motions of each controller", "controller", by_controller(records), columns, note
    )


def survivors_off_axis(record: TrialRecord) -> float | None:
    """Rotation off the axis at the end [deg], of objects that were not lost."""
    return None if record.lost else record.off_rotation_deg


def reason_table(records: Sequence[Record]) -> Table:
    """Why the turns of each controller ended, and how far from the target."""
    found = [name for name in CONTROLLERS if any((r.controller, r.kind) == (name, "turn") for r in records)]
    rows: list[list[Cell]] = []
    for reason in [*(reason.value for reason in StopReason), NotGrasped.reason]:
        cells: list[Cell] = []
        for name in found:
            those = [r for r in records if (r.controller, r.kind, r.reason) == (name, "turn", reason)]
            errors = [r.true_error_deg for r in stats.select(those) if not r.lost]
            off = f" ({np.mean(errors):.2f})" if errors else ""
            cells.append(f"{len(those)}{off}" if those else "-")
        if any(cell != "-" for cell in cells):
            meaning = "no pinch held the object"
            if reason != NotGrasped.reason:
                meaning = _MEANINGS.get(StopReason(reason), "a guard stopped it")
            rows.append([reason, *cells, meaning])
    columns = ["reason", *(f"{name}: turns (error [deg])" for name in found), "what it means"]
    note = "Turns, and in brackets the mean true error at their end; none of lost objects."
    return Table("stop_reasons", "Why the turns ended", columns, rows, note)


def comparison_table(records: Sequence[Record], limit: int) -> Table:
    """E-KM against KM and KM+I in everything that is measured."""
    values: dict[str, tuple[str, Value]] = {
        "steady-state error": ("turn", steady_state_error),
        "motions to settle": ("turn", stats.settle_steps(limit)),
        "error of the first motion": ("turn", lambda r: r.first_step_deg),
        "error of a motion": ("turn", lambda r: r.step_error_deg),
        "rotation off the axis": ("turn", survivors_off_axis),
        "error of one long step": ("long step", steady_state_error),
        "steady-state error, camera off": ("camera off", steady_state_error),
    }
    rows: list[list[Cell]] = []
    there, n_seeds = {r.controller for r in records}, len({r.seed for r in records})
    pairs = [pair for pair in _PAIRS if there.issuperset(pair)]
    for what, (kind, value) in values.items():
        if kind != "turn" and not any(r.kind == kind for r in records):
            continue
        row: list[Cell] = [what]
        for ours, theirs in pairs:
            row += ratio_and_p(*paired(records, ours, theirs, value, kind), n_seeds)
        rows.append(row)
    columns: list[Column | str] = ["ratio of"]
    for pair in map(" : ".join, pairs):
        columns += [Column(f"{pair} [%]", ".0f", percent=True), Column(f"p, {pair}", ".1g")]
    note = (
        "Ratio of means over the same objects and seeds, 95 % bootstrap over pairs, p of the paired t-test "
        f"(none with fewer than {LEAST_SEEDS} seeds)."
    )
    return Table("comparison", "Paired ratios", columns, rows, note)


def paired(
    records: Sequence[Record], ours: str, theirs: str, value: Value, kind: str = "turn"
) -> tuple[Array, Array]:
    """Unit means of two controllers over trials of one kind, for the units that both have."""
    mine, others = (stats.select(records, controller=name, kind=kind) for name in (ours, theirs))
    return stats.paired_means(mine, others, value)


def ratio_and_p(ours: Array, theirs: Array, n_seeds: int) -> tuple[Estimate | None, float | None]:
    """Ratio of means, and p of the paired t-test, where there are such and enough seeds."""
    if not len(ours) or theirs.mean() == 0:
        return None, None
    tests = stats.paired_test(ours, theirs) if n_seeds >= LEAST_SEEDS else None
    return bootstrap_ratio(ours, theirs), None if tests is None else tests.paired_p


def prediction_means(records: Sequence[Record], kind: str = "") -> tuple[Array, Array]:
    """Unit means of the one-step prediction errors of E-KM and KM on the E-KM's own motions [deg].

    Args:
        kind: "true_" for errors against the plant's truth.
    """
    mine = [r for r in stats.select(records, controller="E-KM", kind="turn") if r.prediction_ekm_deg]
    names = (f"{kind}prediction_ekm_deg", f"{kind}prediction_km_deg")
    return stats.paired_means(mine, mine, *(stats.mean_of(name) for name in names))


def prediction_cells(records: Sequence[Record], kind: str = "") -> list[Cell]:
    """KM, E-KM, and their ratio; nothing where no E-KM moved."""
    ours, theirs = prediction_means(records, kind)
    if not len(ours):
        return [None] * 3
    return [stats.bootstrap_mean(theirs), stats.bootstrap_mean(ours), bootstrap_ratio(ours, theirs)]


def prediction_table(records: Sequence[Record]) -> Table:
    """One-step prediction error of KM and E-KM on the E-KM's own motions."""
    rows = [
        [name, *prediction_cells(mine), *prediction_cells(mine, "true_")]
        for name, mine in by_object(records).items()
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


def by_object(records: Sequence[Record]) -> dict[str, list[Record]]:
    """Records of each object, and of all."""
    names = dict.fromkeys(r.object for r in records)
    return {name: [r for r in records if r.object == name] for name in names} | {"all": list(records)}


def timing_table(records: Sequence[Record]) -> Table:
    """Decision and training, without plant and camera."""
    rows = []
    for name, mine in by_controller(records).items():
        seconds = 1e3 * np.array([s for r in mine for s in r.seconds])
        if seconds.size:
            rows.append([name, *map(float, np.percentile(seconds, [50, 90, 99])), seconds.size])
    columns = [Column(name, ".1f") for name in ("controller", "median [ms]", "90 % [ms]", "99 % [ms]")]
    note = "Wall-clock time on the machine that ran the report, with whatever else it was doing."
    return Table("timing", "Time of one control step", [*columns, "motions"], rows, note)


def verdict(records: Sequence[Record], seeds: Sequence[int]) -> str:
    """How far from the target each controller ends, what was lost and not reached, and from enough seeds the
    ratios of the E-KM to the others."""
    turns, parts = by_controller(records), []
    order = [name for name in ("E-KM", "KM+S", "KM+I", "KM") if name in turns]
    ends = [f"{name} {stats.estimate(turns[name], steady_state_error):.2f} deg" for name in order]
    if ends:
        first = ends[0].replace(" ", " ends ", 1) + " from the target"
        failed = [
            f"{name} {sum(r.lost for r in turns[name])} and {sum(r.not_reached for r in turns[name])} "
            f"of {len(turns[name])}"
            for name in order
        ]
        parts.append(f"The {', '.join([first, *ends[1:]])}, on {_counted(len(seeds), 'seed')}.")
        parts.append(f"Objects lost, and turns that did not reach the target: {', '.join(failed)}.")
    ours, theirs = prediction_means(records)
    if len(ours):
        wrong = f"{stats.bootstrap_mean(ours):.2f} deg, the KM by {stats.bootstrap_mean(theirs):.2f} deg"
        parts.append(f"One motion ahead the E-KM is wrong by {wrong} on the same motions.")
    if len(seeds) >= LEAST_SEEDS:
        ratios = []
        for name in order[1:]:
            ours, theirs = paired(records, "E-KM", name, steady_state_error)
            if order[0] == "E-KM" and len(ours) and theirs.mean() > 0:
                ratios.append(f"{name} {100 * bootstrap_ratio(ours, theirs):.0f} %")
        if ratios:
            parts.append(f"Error of the E-KM over that of {', '.join(ratios)} (paired).")
    parts += [f"{name} was never grasped ({why})." for name, why in _never_grasped(records).items()]
    return f"{' '.join(parts) or 'Nothing to compare.'} {which_seeds(seeds)}"


def warmed_up(turns: int) -> str:
    """What the E-KM does before it is measured."""
    before = f" The E-KM makes {_counted(turns, 'turn')} with each object and seed before those that count."
    return before if turns else ""


def _counted(n: int, what: str) -> str:
    return f"{n} {what}{'' if n == 1 else 's'}"


def _never_grasped(records: Sequence[Record]) -> Mapping[str, str]:
    """Objects that no turn could hold, with the reason of the last try."""
    held = {r.object for r in stats.select(records, kind="turn")}
    failed = [r for r in records if isinstance(r, NotGrasped) and r.kind == "turn"]
    return {r.object: r.message for r in failed if r.object not in held}


def which_seeds(seeds: Sequence[int]) -> str:
    """How many, and what may be concluded from them."""
    few = f" Fewer than {LEAST_SEEDS} seeds: no verdict." if len(seeds) < LEAST_SEEDS else ""
    development = min(seeds) < FIRST_REPORTED
    tuned = " Development seeds: figures may have been tuned on them." if development else ""
    which = f"Seed {seeds[0]}." if len(seeds) == 1 else f"Seeds {seeds[0]} to {seeds[-1]}."
    return f"{which}{few}{tuned}"
