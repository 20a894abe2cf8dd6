"""The paper's generalisation (section IV.C): other objects, the angles of Table I."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from ...exceptions import ParameterError
from ..config import CONTROLLERS, Setting, digest, object_name
from ..records import Record
from ..reporting import statistics as stats
from ..reporting import tables
from ..reporting.plots import crosses_caption, plot_steady_state_error, save_figure
from ..reporting.report import Cell, Column, Report, Table
from ..reporting.statistics import Value, steady_state_error
from ..reporting.tables import Target
from ..runner import Bench
from .protocol import Protocol, Results, records_of

#: Rotations of the paper's Table I [deg].
TABLE_I: dict[str, tuple[float, ...]] = {
    "box": (9, 14, 19, 24, 29),
    "weighted_box": (6, 11, 16, 21, 26),
    "can": (9, 13, 23, 31, 38),
    "bottle": (7, 13, 18, 23, 28),
    "applier": (3, 8, 13, 18, 23),
}
#: Mean steady-state errors of KM and E-KM in the paper's Table II [deg].
TABLE_II: dict[str, tuple[float, float]] = {
    "weighted_box": (1.9, 0.6),
    "box": (2.8, 0.8),
    "bottle": (1.3, 0.5),
    "applier": (1.0, 0.7),
    "can": (1.1, 0.6),
}
#: Angles for objects that Table I does not know [deg].
OTHER_ANGLES = (5.0, 10.0, 15.0, 20.0, 25.0)
_FIRST_WARM_UP = 1000  # number of the first training grasp: never one that is tested
_PROBES = 2000  # and of the first grasp for probes


@dataclass(frozen=True)
class Generalize(Protocol):
    """Several objects, each turned by the angles of Table I, every time from a new grasp.

    A session is one object with one seed. Each E-KM begins it empty and has ``warm_up`` turns, on grasps
    that are not tested, before it is measured; it goes on learning while it is.

    Raises:
        ParameterError: no object, or an angle that is no rotation.
        UnknownNameError: no such controller; the message lists them.
    """

    setting: Setting = field(default_factory=Setting)
    objects: tuple[str, ...] = tuple(TABLE_I)
    """Names or paths of URDF files."""
    angles_deg: tuple[float, ...] | None = None
    """None: Table I, and :data:`OTHER_ANGLES` for objects that are not in it."""
    warm_up: int = 3
    long_step_deg: float = 5.0
    """Probe: a single step of this size, without feedback; 0: left out."""
    blind_deg: float = 6.0
    """Probe: the camera is off for the last part of a turn; 0: left out."""
    controllers: tuple[str, ...] = CONTROLLERS
    poses: bool = False
    """Keep the true poses of every motion, for pictures."""

    bench: ClassVar[type[Bench]] = Bench

    def __post_init__(self) -> None:
        if not self.objects:
            raise ParameterError("objects", self.objects, "at least one object")
        for name in self.objects:
            angles = self.angles_of(name)
            if not angles or not all(0 < abs(angle) < 180 for angle in angles):
                raise ParameterError("angles_deg", self.angles_deg, "angles between 0 and 180 deg")
        for name in self.controllers:
            self.setting.plant_config(name)

    def angles_of(self, object: str) -> tuple[float, ...]:
        """Rotations of one object [deg]."""
        return self.angles_deg if self.angles_deg is not None else TABLE_I.get(object, OTHER_ANGLES)

    def quick(self) -> Self:
        """Two objects, two turns, one probe."""
        small = {"angles_deg": (5.0, 9.0), "warm_up": 1, "long_step_deg": 3.0, "blind_deg": 0.0}
        return dataclasses.replace(self, objects=("box", "can"), **small)

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[str, str, int]]:
        """One for each seed, object and controller."""
        # a job does not depend on which others there are
        alone = {**vars(self), "objects": ("any",), "controllers": CONTROLLERS}
        own = {item: digest(self.setting, (item,), alone, self.angles_of(item)) for item in self.objects}
        return {
            f"generalize_{own[item]}_{object_name(item)}_{name}_{seed}": (item, name, seed)
            for seed in seeds
            for item in self.objects
            for name in self.controllers
        }

    def session(self, object: str, controller: str, seed: int) -> list[Record]:
        """Warm-up (E-KM only), all angles, then the probes, with one object and one seed."""
        bench = self.bench(self.setting.hardware_instance(seed), object, controller)
        turn = partial(bench.trial, seed)
        angles = self.angles_of(object)
        middle = float(np.median(angles))
        warm_up = self.warm_up if bench.learns else 0
        records = [turn(_FIRST_WARM_UP + k, middle, "warm-up") for k in range(warm_up)]
        records += [turn(trial, angle, poses=self.poses) for trial, angle in enumerate(angles)]
        if self.long_step_deg:
            records += [bench.long_step(seed, _PROBES + k, self.long_step_deg) for k in range(2)]
        if self.blind_deg:
            angle = max(middle, self.blind_deg + 3)
            records.append(turn(_PROBES + 10, angle, "camera off", learn=False, blind_deg=self.blind_deg))
        bench.close()
        return records

    def targets(self, results: Results[Record]) -> list[Target]:
        """Set for the four controllers, over all objects."""
        records, limit = records_of(results), self.setting.safety.rule.max_steps
        found = []
        for item, mine in tables.by_object(records).items():
            ours, theirs = tables.paired(mine, "E-KM", "KM", steady_state_error)
            if item != "all" and len(ours):
                ratio = 100 * stats.bootstrap_ratio(ours, theirs).mean
                found.append(Target(f"steady-state error E-KM : KM, {item} [%]", ratio, most=25))
        tests = stats.paired_test(*tables.paired(records, "E-KM", "KM", steady_state_error))
        if tests is not None and len({r.seed for r in records}) >= tables.LEAST_SEEDS:
            found.append(Target("Welch p over all objects", tests.welch_p, most=1e-6))
        shares: list[tuple[str, float, Value]] = [
            ("steady-state error", 100, steady_state_error),
            ("motions to settle", 60, stats.settle_steps(limit)),
            ("error of the first motion", 50, lambda r: r.first_step_deg),
        ]
        for what, aim, value in shares:
            for name in ("KM+I", "KM+S"):
                ours, theirs = tables.paired(records, "E-KM", name, value)
                if len(ours) and theirs.mean() > 0:
                    ratio = 100 * stats.bootstrap_ratio(ours, theirs).mean
                    found.append(Target(f"{what} E-KM : {name} [%]", ratio, most=aim))
        turns = tables.by_controller(records)
        lost = {name: 100 * float(np.mean([r.lost for r in mine])) for name, mine in turns.items()}
        if "E-KM" in lost and "KM+I" in lost:
            difference = lost["E-KM"] - lost["KM+I"]
            found.append(Target("objects lost, E-KM minus KM+I [%]", difference, most=0))
            found.append(Target("objects lost, E-KM [%]", lost["E-KM"], most=5))
        if "KM" in turns:
            mean = float(np.mean(list(stats.unit_means(turns["KM"], steady_state_error).values())))
            found.append(Target("steady-state error of the KM [deg]", mean, least=1, most=3))
        return found

    def report(self, seeds: Sequence[int], results: Results[Record], folder: Path) -> Report:
        """Tables I and II, Fig. 6, and the probes."""
        records, limit = records_of(results), self.setting.safety.rule.max_steps
        figures = []
        for item in self.objects:
            name = object_name(item)
            turns = tables.by_controller(stats.select(records, object=name))
            errors = {
                controller: {
                    f"{angle:g}": np.array([steady_state_error(r) for r in mine if r.angle_deg == angle])
                    for angle in self.angles_of(item)
                }
                for controller, mine in turns.items()
            }
            if errors:
                caption = (
                    f"Steady-state error with the {name.replace('_', ' ')} for each target: every turn, and "
                )
                caption += f"the mean (as in the paper's Fig. 6).{crosses_caption(errors)}"
                plot = plot_steady_state_error(errors, name.replace("_", " "))
                figures.append(save_figure(plot, folder, f"steady_state_error_{name}", caption))
        shown = [
            paper_table(records),
            tables.reason_table(records),
            object_table(records),
            ends_table(records),
            tables.controller_table(records),
            tables.motion_table(records, limit),
            tables.comparison_table(records, limit),
            probe_table(records),
            tables.prediction_table(records),
            self.angles_table(),
            tables.targets_table(self.targets(results)),
            tables.timing_table(records),
        ]
        shown = [table for table in shown if table.rows]
        names = ", ".join(object_name(item) for item in self.objects)
        summary = f"{tables.verdict(records, seeds)} Objects: {names}.{tables.warmed_up(self.warm_up)}"
        leading, legend = int(shown[0].name == "paper"), tables.legend(records)
        title = "Generalisation: other objects, other weights"
        return Report(title, summary, shown, figures, leading=leading, legend=legend)

    def angles_table(self) -> Table:
        """The rotations that were asked for (Table I)."""
        angles = {object_name(item): list(map(float, self.angles_of(item))) for item in self.objects}
        rows = [[name, ", ".join(f"{angle:g}" for angle in turned)] for name, turned in angles.items()]
        columns = ["object", "rotations [deg]"]
        return Table("angles", "Rotations that were asked for", columns, rows)


def paper_table(records: Sequence[Record]) -> Table:
    """The paper's Table II beside the same figures here, for the objects that both have."""
    both = [r for r in records if r.object in TABLE_II]
    ours, theirs = tables.paired(both, "E-KM", "KM", steady_state_error)
    _, p = tables.ratio_and_p(ours, theirs, len({r.seed for r in both}))
    rows: list[list[Cell]] = []
    for item, (km, ekm) in TABLE_II.items():
        by = [stats.select(records, controller=name, kind="turn", object=item) for name in ("KM", "E-KM")]
        if all(by):
            ratio = stats.bootstrap_ratio(*stats.paired_means(by[1], by[0], steady_state_error))
            here = [stats.estimate(mine, steady_state_error) for mine in by]
            rows.append([item, km, here[0], ekm, here[1], ekm / km, ratio])
    columns: list[Column | str] = [
        "object", Column("KM, paper [deg]", ".1f"), "KM, here [deg]", Column("E-KM, paper [deg]", ".1f"),
        "E-KM, here [deg]", Column("E-KM:KM, paper [%]", ".0f", percent=True),
        Column("E-KM:KM, here [%]", ".0f", percent=True),
    ]  # fmt: skip
    note = "Mean steady-state errors; the paper: one iCub hand, here: a simulated hand for each seed. "
    note += f"p over these objects: paper 3.8e-4, here {'-' if p is None else f'{p:.1g}'} (paired)."
    return Table("paper", "The paper's Table II, and the same here", columns, rows, note)


def object_table(records: Sequence[Record]) -> Table:
    """Steady-state error of each object, paired (the paper's Table II)."""
    rows: list[list[Cell]] = []
    for item, chosen in tables.by_object(records).items():
        by = {name: stats.select(chosen, controller=name, kind="turn") for name in CONTROLLERS}
        if not by["KM"] or not by["E-KM"]:
            continue
        ours, theirs = stats.paired_means(by["E-KM"], by["KM"], steady_state_error)
        enough = len({r.seed for r in chosen}) >= stats.LEAST_SEEDS
        tests = stats.paired_test(ours, theirs) if enough else None
        figures = (None, None) if tests is None else (tests.paired_p, tests.effect_size)
        row: list[Cell] = [item, *(stats.estimate(mine, steady_state_error) for mine in by.values())]
        rows.append([*row, stats.bootstrap_ratio(ours, theirs), *figures])
    columns = [
        "object", *(f"{name} [deg]" for name in CONTROLLERS), Column("E-KM:KM [%]", ".0f", percent=True),
        Column("p paired", ".1g"), Column("effect size", ".1f"),
    ]  # fmt: skip
    note = (
        "Steady-state error, lost objects with the whole angle. Ratio of means with the bootstrap over "
        "pairs of object and seed; the effect size is Cohen's d of the paired differences."
    )
    return Table("by_object", "Steady-state error of each object", columns, rows, note)


def ends_table(records: Sequence[Record]) -> Table:
    """Lost objects and turns that did not reach the target, for each object and controller."""
    rows: list[list[Cell]] = []
    names = list(tables.by_controller(records))
    for item, chosen in tables.by_object(records).items():
        by = [stats.select(chosen, controller=name, kind="turn") for name in names]
        rows.append(
            [item, *(f"{sum(r.lost for r in mine)}, {sum(r.not_reached for r in mine)}" for mine in by)]
        )
    columns = ["object", *(f"{name} lost, not reached" for name in names)]
    return Table("ends", "Objects lost, and turns that did not reach the target", columns, rows)


def probe_table(records: Sequence[Record]) -> Table:
    """What the model is worth without feedback: one long step, and turns that end with the camera off."""
    steps, dark = (tables.by_controller(records, kind) for kind in ("long step", "camera off"))
    items = {name: name for name in CONTROLLERS if name in steps or name in dark}
    columns: dict[Column, Callable[[str], Cell]] = {
        Column("one long step [deg]"): lambda name: stats.estimate(steps.get(name, []), steady_state_error),
        Column("lost in it"): lambda name: stats.rate(r.lost for r in steps.get(name, [])),
        Column("camera off [deg]"): lambda name: stats.estimate(dark.get(name, []), steady_state_error),
        Column("lost then"): lambda name: stats.rate(r.lost for r in dark.get(name, [])),
    }
    return Table.of("probes", "True error without feedback", "controller", items, columns)
