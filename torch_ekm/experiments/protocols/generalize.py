"""The paper's generalisation (section IV.C): other objects, each turned by shares of its workspace."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from ...description import load_object
from ...exceptions import ParameterError
from ..config import CONTROLLERS, Setting, digest, object_name
from ..records import TrialRecord
from ..reporting import statistics as stats
from ..reporting import tables
from ..reporting.plots import plot_steady_state_error, save_figure
from ..reporting.report import Cell, Column, Report, Table
from ..reporting.statistics import DataFrame, select
from ..runner import FIRST_GRASP, Bench
from .protocol import Protocol

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
#: Upper ends of the workspaces of other objects in this hand [deg]: what three of four grasps reach in
#: turns that were asked for too much, seeds 0 to 7.
ENDS: dict[str, float] = {
    "pen_case": 45, "flashlight": 89, "charger": 25, "tea_tin": 16, "jar": 33, "carton": 6,
}  # fmt: skip
#: Shares of the end that are asked for, as in Table I.
SHARES = (0.2, 0.4, 0.6, 0.8, 1.0)
#: Angles for objects whose end nobody has found [deg].
OTHER_ANGLES = (5.0, 10.0, 15.0, 20.0, 25.0)


@dataclass(frozen=True)
class Generalize(Protocol):
    """Several objects, each turned by five shares of its workspace, every time from a new grasp.

    A session is one object with one seed. Each E-KM begins it empty and has ``warm_up`` turns, on grasps
    that are not tested, before it is measured; it goes on learning while it is.

    Raises:
        ParameterError: no object, or an angle that is no rotation.
        UnknownNameError: no such object or controller; the message lists them.
        DescriptionError: files of an object are missing or wrong.
    """

    setting: Setting = field(default_factory=Setting)
    objects: tuple[str, ...] = tuple(TABLE_I)
    """Names or paths of URDF files."""
    angles_deg: tuple[float, ...] | None = None
    """None: those of Table I, by its rule 20 to 100 % of an object's end (:data:`ENDS`), or
    :data:`OTHER_ANGLES`."""
    warm_up: int = 3
    controllers: tuple[str, ...] = CONTROLLERS
    poses: bool = False
    """Keep the true poses of every motion, for pictures."""

    def __post_init__(self) -> None:
        if not self.objects:
            raise ParameterError("objects", self.objects, "at least one object")
        for name in self.objects:
            load_object(name)
            angles = self.angles_of(name)
            if not angles or not all(0 < abs(angle) < 180 for angle in angles):
                raise ParameterError("angles_deg", self.angles_deg, "angles between 0 and 180 deg")
        for name in self.controllers:
            self.setting.plant_config(name)

    def angles_of(self, object: str) -> tuple[float, ...]:
        """Rotations that are asked for with one object [deg]."""
        if self.angles_deg is not None:
            return self.angles_deg
        shares = tuple(round(share * ENDS[object], 1) for share in SHARES) if object in ENDS else OTHER_ANGLES
        return TABLE_I.get(object, shares)

    def quick(self) -> Self:
        """The same with two objects and two turns."""
        return dataclasses.replace(self, objects=("box", "can"), angles_deg=(5.0, 9.0), warm_up=1)

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

    def session(self, object: str, controller: str, seed: int) -> list[TrialRecord]:
        """Warm-up (E-KM only), then all angles, with one object and one seed."""
        bench = Bench(self.setting.hardware_instance(seed), object, controller)
        angles = self.angles_of(object)
        middle = float(np.median(angles))
        before = range(FIRST_GRASP, FIRST_GRASP + self.warm_up * bench.learns)
        records = [bench.trial(seed, k, middle, "warm-up") for k in before]
        records += [bench.trial(seed, k, angle, poses=self.poses) for k, angle in enumerate(angles)]
        bench.close()
        return records

    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Table II, and Fig. 6 with its cells and p-values."""
        turns, figures = select(trials, kind="turn"), []
        if len(turns):
            caption = "Steady-state error with each object for each target: every turn, and the mean (the "
            caption += "paper's Fig. 6). Crosses at the upper edge: errors above."
            figures = [save_figure(plot_steady_state_error(turns), folder, "steady_state_error", caption)]
        shown = [
            paper_table(trials),
            significance_table(trials),
            tables.reason_table(trials),
            tables.error_table(trials, "object"),
            tables.controller_table(trials),
        ]
        shown = [table for table in shown if table.rows]
        names = ", ".join(object_name(item) for item in self.objects)
        summary = f"{tables.verdict(trials, seeds)} Objects: {names}."
        if self.warm_up:
            summary += (
                f" Turns of the E-KM with each object and seed before those that count: {self.warm_up}."
            )
        leading, legend = int(shown[0].name == "paper"), tables.legend(trials)
        title = "Generalisation: other objects, other weights"
        return Report(title, summary, shown, figures, leading=leading, legend=legend)


def paper_table(trials: DataFrame) -> Table:
    """The paper's Table II next to the same figures here, for the objects that both have."""
    both = trials[trials["object"].isin(list(TABLE_II))]
    rows: list[list[Cell]] = []
    for item, (km, ekm) in TABLE_II.items():
        by = tables.by_controller(both[both["object"] == item])
        if {"KM", "E-KM"} <= set(by):
            here = [stats.estimate(by[name], "error_deg") for name in ("KM", "E-KM")]
            ratio = tables.ratio(both[both["object"] == item], "KM")
            rows.append([item, km, here[0], ekm, here[1], ekm / km, ratio])
    columns: list[Column | str] = [
        "object", Column("KM, paper [deg]", ".1f"), "KM, here [deg]", Column("E-KM, paper [deg]", ".1f"),
        "E-KM, here [deg]", Column("E-KM:KM, paper [%]", ".0f", percent=True),
        Column("E-KM:KM, here [%]", ".0f", percent=True),
    ]  # fmt: skip
    note = "Mean steady-state errors; the paper: one iCub hand, here: a simulated hand for each seed."
    return Table("paper", "The paper's Table II, and the same here", columns, rows, note)


def significance_table(trials: DataFrame) -> Table:
    """Cells that the E-KM wins on a hand, and the tests of its errors, of the paper's objects if any."""
    both = trials[trials["object"].isin(list(TABLE_II))]
    chosen, rows = both if len(both) else trials, []
    turns, cells = select(chosen, kind="turn"), ["object", "trial", "angle_deg"]
    ekm, km = (  # a row for each cell, a column for each hand
        select(turns, controller=name).pivot_table("error_deg", cells, "seed", sort=False)
        for name in ("E-KM", "KM")
    )
    ekm, km = ekm.align(km, join="inner")
    seeds = (ekm - km).dropna(axis=1).columns
    if len(seeds) and len(ekm) > 1:
        hands = [(ekm[seed].to_numpy(), km[seed].to_numpy()) for seed in seeds]
        won = ekm[seeds] < km[seeds]
        lost = [f"{cell[0]}, trial {cell[1] + 1} ({n})" for cell, n in (~won).sum(axis=1).items() if n]
        wins = won.sum()
        rows = [
            ["cells won", "24 of 25", f"{wins.median():g} of {len(won)}, least {wins.min()}"],
            ["cells lost (hands)", "can, trial 2", "; ".join(lost) or "none"],
            tables.p_row(hands, "3.8e-4"),
        ]
    note = (
        "A cell is an object with a target; the E-KM wins it where it ends nearer than the KM. As in the "
        "paper one hand turns each cell once: medians over hands."
    )
    return Table("significance", "Cells won, and p-values", ["figure", "paper", "here"], rows, note)
