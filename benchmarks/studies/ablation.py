"""What each part of model and learner is worth: one change at a time, on the same seeds and grasps.

    python benchmarks/studies/ablation.py --seeds 1000:1010 --out FOLDER

Parts of the plan: ``python benchmarks/whole_turn.py --variants``. Interrupted, it goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from oracle import TURNS_ALONE
from run_study import run_study

from torch_ekm.experiments.config import Setting, object_name
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.protocols.protocol import Protocol
from torch_ekm.experiments.records import Record
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.reporting.statistics import DataFrame, estimate, rate
from torch_ekm.experiments.reporting.tables import (
    LEGEND,
    by_controller,
    prediction_cells,
    warmed_up,
    which_seeds,
)
from torch_ekm.simulation import PRESETS

_DEG = math.pi / 180
_BASE = "as it is"
_LEARNING, _BOTH, _ALL = ("E-KM",), ("KM", "E-KM"), ("KM", "KM+I", "KM+S", "E-KM")

#: Disturbances of the nominal plant, each alone in a plant that is otherwise exact.
DISTURBANCES: dict[str, tuple[str, ...]] = {
    "pulley radii": ("moment_arm",),
    "joint springs": ("spring",),
    "servo stiffness": ("servo_stiffness",),
    "joint friction": ("joint_friction",),
    "weight of the fingers": ("link_weight",),
    "friction, mass, centre": ("friction", "mass", "com_shift"),
    "actuator bias": ("actuator_bias",),
    "fresh actuator error": ("actuator_error",),
    "dead zone": ("dead_zone",),
    "backlash": ("backlash",),
    "noise of the sensors": (
        "joint_noise", "position_noise", "rotation_noise", "force_noise", "force_offset", "force_hysteresis",
        "force_range",
    ),
}  # fmt: skip

LEARNERS = (
    "action-linear", "rbf", "SOGP plain", "SOGP deep", "linear RLS", "random features", "MLP",
    "model alone",
)  # fmt: skip


@dataclass(frozen=True)
class Variant:
    """One change, and the controllers that it concerns."""

    group: str
    name: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Of the :class:`Setting`."""
    controllers: tuple[str, ...] = _BOTH


def _model(**figures: Any) -> Callable[[Setting], dict[str, Any]]:
    return lambda base: {"model": replace(base.model, **figures)}


def _dead_zone(degrees: float) -> Callable[[Setting], dict[str, Any]]:
    return lambda base: {"plant": base.parameters.replace(dead_zone=degrees * _DEG)}


def _learner(**options: Any) -> Callable[[Setting], dict[str, Any]]:
    return lambda base: {"learner_options": {**base.learner_options, **options}}


#: Group, name, what is changed in the setting, and the controllers that it concerns.
_OPTIONS: list[tuple[str, str, Callable[[Setting], dict[str, Any]], tuple[str, ...]]] = [
    ("online learning", "no robust update", _learner(robust=None), _LEARNING),
    ("online learning", "no forgetting", _learner(forgetting_factor=1.0), _LEARNING),
    ("model", "no rolling", _model(rolling=False), _BOTH),
    ("model", "rigid actuators", _model(actuator_compliance=False), _BOTH),
    *(("dead zone", f"{x:g} deg", _dead_zone(x), _ALL) for x in (0, 0.5, 0.9, 1.3, 1.7)),
]


def variants(base: Setting) -> list[Variant]:
    """All variants of a setting; most groups begin with the unchanged one."""
    nominal, exact = vars(PRESETS["nominal"]), PRESETS["none"]
    others = [name for name in LEARNERS if name != base.learner]
    plants = {
        name: exact.replace(**{key: nominal[key] for key in keys}) for name, keys in DISTURBANCES.items()
    }
    return [
        *(Variant(group, _BASE) for group in ("learner", "online learning", "model")),
        Variant("preset", f"{base.preset}: {_BASE}"),
        *(Variant("learner", name, {"learner": name, "learner_options": {}}, _LEARNING) for name in others),
        Variant("learner", "rbf over commands", {"learner": "rbf", "servo_inverse": False}, _LEARNING),
        *(Variant(group, name, change(base), controllers) for group, name, change, controllers in _OPTIONS),
        Variant("online learning", "f as described", {"adapts": False}, _LEARNING),
        *(
            Variant("online learning", f"{capacity} basis vectors", {"capacity": capacity}, _LEARNING)
            for capacity in (15, 30, 120)
        ),
        *(Variant("preset", name, {"preset": name}, _ALL) for name in PRESETS if name != base.preset),
        *(
            Variant("disturbance", name, {"preset": "none", "plant": plant}, _ALL)
            for name, plant in plants.items()
        ),
    ]


@dataclass(frozen=True)
class Ablation(Protocol):
    """One object, some angles, every variant."""

    setting: Setting = field(default_factory=Setting)
    object: str = "box"
    angles_deg: tuple[float, ...] = (9.0, 19.0, 29.0)
    warm_up: int = 3
    groups: tuple[str, ...] = ("learner", "online learning", "model", "preset", "disturbance", "dead zone")

    def quick(self) -> Self:
        """The learners, with one turn."""
        return dataclasses.replace(self, angles_deg=(6.0,), warm_up=1, groups=("learner",))

    def variants(self, group: str) -> list[Variant]:
        """What is compared in one group."""
        return [variant for variant in variants(self.setting) if variant.group == group]

    def jobs(self, seeds: Sequence[int]) -> dict[str, tuple[Generalize, str, int]]:
        """One for each seed, variant and controller; variants that are alike share their jobs."""
        chosen = [variant for group in self.groups for variant in self.variants(group)]
        return {name: job for variant in chosen for name, job in self._jobs_of(variant, seeds).items()}

    def session(self, variant: Generalize, controller: str, seed: int) -> list[Record]:
        """All turns with one variant, controller and seed."""
        return variant.session(variant.objects[0], controller, seed)

    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Two tables for each group: where the turns end, and what a motion of the E-KM is worth."""
        shown = [make(group, seeds, trials) for group in self.groups for make in (self.table, self.motions)]
        angles = ", ".join(f"{angle:g}" for angle in self.angles_deg)
        summary = f"{self._answer(seeds, trials)} One change at a time; {object_name(self.object)}, turns of "
        summary += f"{angles} deg. "
        summary += f"{which_seeds(seeds)}{warmed_up(self.warm_up)}"
        title = "Ablations: the effect of each part"
        names = {c for v in self._variants() for c in v.controllers}
        explained = {name: line for name, line in LEGEND.items() if name in names}
        return Report(title, summary, shown, leading=2, legend=explained)

    def _variants(self) -> list[Variant]:
        return [variant for group in self.groups for variant in self.variants(group)]

    def _answer(self, seeds: Sequence[int], trials: DataFrame) -> str:
        """How the E-KM does as it is; what changes it, from enough seeds alone."""
        base = next((v for v in self._variants() if v.name == _BASE), None)
        if base is None:
            return ""
        mine = self._turns(base, seeds, trials).get("E-KM")
        if mine is None:
            return "Nothing was grasped."
        lost, missed = mine["lost"].sum(), mine["not_reached"].sum()
        text = (
            f"The E-KM as it is ends {estimate(mine, 'error_deg'):.2f} deg from the target; of {len(mine)} "
        )
        return f"{text}turns {lost} objects were lost and {missed} turns did not reach the target."

    def _turns(self, variant: Variant, seeds: Sequence[int], trials: DataFrame) -> dict[str, DataFrame]:
        """The turns of a variant, of each controller that has any."""
        return by_controller(trials[trials["job"].isin(list(self._jobs_of(variant, seeds)))])

    def table(self, group: str, seeds: Sequence[int], trials: DataFrame) -> Table:
        """Where the turns of the variants of one group end."""
        rows: list[list[Cell]] = []
        for variant in self.variants(group):
            turns = self._turns(variant, seeds, trials)
            row: list[Cell] = [variant.name]
            row += [estimate(turns[name], "error_deg") if name in turns else None for name in _ALL]
            row += [rate(turns[name]["lost"]) if name in turns else None for name in ("KM+I", "E-KM")]
            rows.append([*row, rate(turns["E-KM"]["not_reached"]) if "E-KM" in turns else None])
        columns = [group, *(f"{name} [deg]" for name in _ALL), "KM+I lost", "E-KM lost", "E-KM not reached"]
        note = (
            f"{object_name(self.object)}, {len(seeds)} seeds. Steady-state error by the truth, "
            "lost objects with the whole angle; 95 % bootstrap intervals over seeds."
        )
        return Table(f"ablation_{group.replace(' ', '_')}", f"Ablation: {group}", columns, rows, note)

    def motions(self, group: str, seeds: Sequence[int], trials: DataFrame) -> Table:
        """What the motions of the E-KM are worth with the variants of one group."""
        rows: list[list[Cell]] = []
        for variant in self.variants(group):
            mine = self._turns(variant, seeds, trials).get("E-KM")
            if mine is not None:
                *predicted, _ = prediction_cells(mine)
                measured = [estimate(mine, column) for column in ("motions", "first_step_deg")]
                rows.append([variant.name, *measured, *predicted, prediction_cells(mine, "true_")[-1]])
        columns = [
            group, Column("motions", ".1f"), "first motion [deg]", "predicted by the KM [deg]",
            "by the E-KM [deg]", Column("ratio, true [%]", ".0f", percent=True),
        ]  # fmt: skip
        name = f"ablation_{group.replace(' ', '_')}_motions"
        note = (
            "Motions of a turn of the E-KM. First motion: deviation of its change of the error from the "
            "commanded one. Errors of one-step predictions on its motions, as measured, and E-KM over KM by "
            "the truth."
        )
        return Table(name, f"Ablation: {group}, motions of the E-KM", columns, rows, note)

    def _jobs_of(self, variant: Variant, seeds: Sequence[int]) -> dict[str, tuple[Generalize, str, int]]:
        one = Generalize(
            self.setting.replace(**variant.changes),
            objects=(self.object,),
            angles_deg=self.angles_deg,
            warm_up=self.warm_up,
            controllers=variant.controllers,
            **TURNS_ALONE,
        )
        return {name: (one, controller, seed) for name, (_, controller, seed) in one.jobs(seeds).items()}


if __name__ == "__main__":
    run_study(Ablation(Setting(sensing=True)), __doc__)
