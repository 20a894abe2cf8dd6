"""The paper's online manipulation (section IV.B): learning while turning, with things that go wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from ..._extras import require
from ...simulation import PlantChange, Tug
from ..config import CONTROLLERS, Setting, digest, object_name
from ..records import TrialRecord
from ..reporting import tables
from ..reporting.plots import plot_learning_test, plot_prediction_error, save_figure
from ..reporting.report import Cell, Column, Report, Table
from ..reporting.statistics import LEAST_SEEDS, DataFrame, bootstrap_mean, learning_curve, select
from ..runner import Bench
from .protocol import Protocol

_LEARNED = 16
"""Trials after which the paper's learner has learned."""
_KNOCK = (0.0, 0.10, 0.0)
"""Torque of a knock [N m], hand frame, for 50 ms: it turns the tube by 5 to 10 deg."""
_NEW_TENDONS = {"moment_arm": 1.15, "servo_stiffness": 0.8}
"""The plant then has tighter tendons, and less stretch."""


@dataclass(frozen=True)
class Online(Protocol):
    """Random grasps and rotations of one object, with things that go wrong on the way.

    All trials of one seed are a session; an E-KM starts empty and keeps what it learns. Trials count
    from 1, as in the paper.
    """

    setting: Setting = field(default_factory=Setting)
    object: str = "toothpaste"
    trials: int = 45
    angle_range_deg: tuple[float, float] = (6.0, 24.0)
    """Rotations are drawn from this interval."""
    dislocations: tuple[int, ...] = (20, 44)
    """In these trials the object is knocked after its third motion."""
    tendons_replaced: int = 31
    """Before this trial the tendons are replaced (0: never)."""
    controllers: tuple[str, ...] = CONTROLLERS

    @property
    def events(self) -> tuple[int, ...]:
        """Trials in which something happens, those that take place."""
        replaced = (self.tendons_replaced,) if self.tendons_replaced else ()
        return tuple(sorted(t for t in (*self.dislocations, *replaced) if t <= self.trials))

    def quick(self) -> Self:
        """Four trials, an event in the last two."""
        small = {"trials": 4, "angle_range_deg": (5.0, 8.0), "dislocations": (3,), "tendons_replaced": 4}
        return dataclasses.replace(self, **small)

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[str, int]]:
        """One for each seed and controller: all trials in order."""
        alone = dataclasses.replace(self, controllers=CONTROLLERS)  # a job does not depend on the others
        stem = f"online_{digest(self.setting, (self.object,), alone)}"
        return {f"{stem}_{name}_{seed}": (name, seed) for seed in seeds for name in self.controllers}

    def session(self, controller: str, seed: int) -> list[TrialRecord]:
        """All trials of one seed, in order."""
        angles = np.random.default_rng(seed).uniform(*self.angle_range_deg, size=self.trials)
        bench = Bench(self.setting.hardware_instance(seed), self.object, controller)
        records = []
        for trial, angle in enumerate(angles.tolist(), start=1):
            if trial == self.tendons_replaced:
                PlantChange(0, _NEW_TENDONS).happen(bench.hand)
            events = (Tug(at=3, torque=_KNOCK),) if trial in self.dislocations else ()
            records.append(bench.trial(seed, trial, angle, events=events))
        bench.close()
        return records

    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Fig. 5a and 5b, and every controller's turns."""
        figures = []
        ekm, km = curves = prediction_curves(trials, self.trials)
        moved = ekm.columns[ekm.notna().any()]
        if len(moved) > 1:
            events = f"trials {', '.join(map(str, self.events))}" if self.events else "none"
            over = f", median and quartiles over {len(ekm)} seeds" if len(ekm) > 1 else ""
            caption = (
                f"One-step prediction error in each trial{over} (the paper's Fig. 5a). Events: {events}."
            )
            happened = {trial: "dislocated" for trial in self.dislocations if trial <= self.trials}
            happened |= {self.tendons_replaced: "new tendons"} if self.tendons_replaced in self.events else {}
            figure = plot_prediction_error(ekm[moved], km[moved], events=happened)
            figures.append(save_figure(figure, folder, "prediction_error", caption))
        first = [curve.iloc[0].dropna().to_numpy() for curve in curves]
        if len(first[0]) > 1:
            caption = (
                f"The first k trials of seed {min(seeds)} (the paper's Fig. 5b). Left: p of the test whether "
                "the E-KM's error is smaller than the KM's; right: upper end of their difference's interval."
            )
            figures.append(save_figure(plot_learning_test(*first), folder, "learning_test", caption))
        shown = [
            self.paper_table(trials),
            tables.reason_table(trials),
            tables.controller_table(trials),
        ]
        what = f"{self.trials} turns of the {object_name(self.object)} for each seed and controller."
        if len(seeds) >= LEAST_SEEDS:
            negative = shown[0].text()[0][2]
            what += f" The E-KM predicts better for good after {negative} trials (the paper: 16)."
        summary, legend = f"{tables.verdict(trials, seeds)} {what}", tables.legend(trials)
        return Report("Online manipulation: learning while turning", summary, shown, figures, legend=legend)

    def paper_table(self, trials: DataFrame) -> Table:
        """The figures that the paper prints, next to those found here."""
        ekm, km = prediction_curves(trials, self.trials)
        learned = learning(ekm, km, self.events)
        rows: list[list[Cell]] = []
        for name, what, paper in (
            ("last_negative", "trials until significant (last index of negative result)", "16"),
            ("last_upper", "last upper boundary [deg]", "-0.57"),
            ("late", f"E-KM:KM after {_LEARNED} trials", None),
            *(
                (f"after_{event}", f"trials until recovered after trial {event}", None)
                for event in self.events
            ),
        ):
            found = learned[name].dropna().to_numpy()
            rows.append([what, paper, bootstrap_mean(found) if len(found) else None, len(found)])
        hands = [(ekm.loc[seed].dropna(), km.loc[seed].dropna()) for seed in ekm.index]
        rows.append([*tables.p_row(hands, "< 0.05"), len(ekm)])
        columns = ["figure", "paper", Column("here, mean over seeds", ".2f"), "seeds"]
        note = (
            "Means over the seeds that have one. After how many trials the E-KM predicts better for good (1: "
            "from the first test on, which needs two), and by how much at least at the end. Recovered: its "
            "error is below half of the KM's; trials with an event are left out of the ratio."
        )
        return Table("paper", "Figures of the paper and those found here", columns, rows, note)


def learning(ekm: DataFrame, km: DataFrame, events: Sequence[int]) -> DataFrame:
    """How fast learners learned: a row for each seed, NaN where there were too few trials to say.

    =============  ==================================================================================
    last_negative  last k for which the first k trials show no advantage
    last_upper     upper end of the last one-sided interval of E-KM minus KM [deg]
    late           E-KM : KM after 16 trials, without those with an event
    after_20, ...  trials after the event of trial 20 until the E-KM's error is below half of the KM's
    =============  ==================================================================================

    Args:
        ekm, km: of :func:`prediction_curves`.
        events: trials.
    """
    rows = {}
    for seed in ekm.index:
        both = require("pandas").DataFrame({"ekm": ekm.loc[seed], "km": km.loc[seed]}).dropna()
        calm = both[(both.index > _LEARNED) & ~both.index.isin(events)].mean()
        rows[seed] = dict.fromkeys(("last_negative", "last_upper"), np.nan) | {"late": calm.ekm / calm.km}
        if len(both) > 1:
            curve = learning_curve(both["ekm"].to_numpy(), both["km"].to_numpy())
            rows[seed] |= {"last_negative": curve.last_negative, "last_upper": curve.last_upper}
        better = both.index[both["ekm"] < 0.5 * both["km"]]
        rows[seed] |= {f"after_{event}": (better[better > event] - event).min() for event in events}
    return require("pandas").DataFrame.from_dict(rows, orient="index").astype(float)


def prediction_curves(trials: DataFrame, n: int) -> tuple[DataFrame, DataFrame]:
    """Prediction errors of E-KM and KM [deg], a row for each seed, columns 1 to n; NaN: nothing moved."""
    mine, seeds = select(trials, controller="E-KM"), sorted(trials["seed"].unique())
    ekm, km = (
        mine.pivot(index="seed", columns="trial", values=f"prediction_{name}")
        .reindex(index=seeds, columns=range(1, n + 1))
        .astype(float)
        for name in ("ekm", "km")
    )
    return ekm, km
