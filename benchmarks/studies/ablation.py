"""What each part is worth: one change at a time, on the same seeds and grasps.

    python benchmarks/studies/ablation.py --seeds 1000:1010 --out FOLDER

With 20 seeds, 3140 sessions of 3 to 6 turns: 5 h on two cores. Interrupted, it goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from oracle import OracleGeneralize
from run_study import run_study

from torch_ekm.experiments.config import Setting, object_name
from torch_ekm.experiments.learners import HAND_LEARNERS
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.protocols.protocol import Protocol, Results
from torch_ekm.experiments.records import Record
from torch_ekm.experiments.reporting.report import Cell, Column, Report, Table
from torch_ekm.experiments.reporting.statistics import estimate, rate, steady_state_error
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


@dataclass(frozen=True)
class Variant:
    """One change, and the controllers that it concerns."""

    group: str
    name: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Of the :class:`Setting`."""
    controllers: tuple[str, ...] = _BOTH
    protocol: type[Generalize] = Generalize


#: Group, name, field of the setting, what is changed in it, and the controllers that it concerns.
_OPTIONS: list[tuple[str, str, str, dict[str, Any], tuple[str, ...]]] = [
    ("online learning", "no robust update", "learner_options", {"robust": None}, _LEARNING),
    ("online learning", "no forgetting", "learner_options", {"forgetting_factor": 1.0}, _LEARNING),
    ("model", "no rolling", "model", {"rolling": False}, _BOTH),
    ("model", "rigid actuators", "model", {"actuator_compliance": False}, _BOTH),
    ("controller", "gain 1 near the goal", "control", {"LimitingFunction.gain": 1.0}, _ALL),
    ("controller", "gain 0.6 near the goal", "control", {"LimitingFunction.gain": 0.6}, _ALL),
    ("controller", "steps of 1.5 deg", "control", {"LimitingFunction.step": 1.5 * _DEG}, _ALL),
    (
        "controller", "steps of 6 deg, 2 mm", "control",
        {"LimitingFunction.step": 6 * _DEG, "LimitingFunction.contact_travel": 2e-3}, _ALL,
    ),
    (
        "controller", "actuators cut at 6 deg", "control",
        {"ActuatorLimit.step": 6 * _DEG, "JointLimit.horizon": 6 * _DEG}, _ALL,
    ),
    ("controller", "rows for the friction margin", "control", {"FrictionMarginLimit.minimum": 0.5}, _ALL),
    ("care", "a grip of 5 N for every object", "control", {"GripForceTask.force": 5.0}, _ALL),
    (
        "care", "the pace fixed", "control",
        {"TrustRegion.start": 1.0, "TrustRegion.smallest": 1.0, "TrustRegion.largest": 1.0}, _LEARNING,
    ),
    ("care", "steps never cut", "control", {"StepBound.least": math.inf}, _ALL),
    ("care", "large steps with uneven forces", "control", {"StepBound.even": 1e-3}, _LEARNING),
    ("care", "no second look", "control", {"Caution.looks": 0}, _ALL),
    (
        "care", "no way back", "control",
        {"Caution.off_rotation": math.inf, "Caution.link_gap": -math.inf, "Caution.way_back": 0}, _ALL,
    ),
    *(("dead zone", f"{x:g} deg", "plant", {"dead_zone": x * _DEG}, _ALL) for x in (0, 0.5, 0.9, 1.3, 1.7)),
]  # fmt: skip


def variants(base: Setting) -> list[Variant]:
    """All variants of a setting; most groups begin with the unchanged one."""
    nominal = dataclasses.asdict(PRESETS["nominal"])
    others = [name for name in HAND_LEARNERS if name != base.learner]
    plants = {name: {key: nominal[key] for key in keys} for name, keys in DISTURBANCES.items()}
    return [
        *(Variant(group, _BASE) for group in ("learner", "online learning", "model")),
        *(Variant(group, _BASE, controllers=_ALL) for group in ("controller", "care")),
        Variant("care", "oracle: true model, pose and forces", {}, ("KM+S",), OracleGeneralize),
        Variant("care", "pose and joints from six readings at rest", {"frames": 6}, _ALL),
        Variant("care", "the same, to a tolerance of 0.1 deg", {"frames": 6, "tolerance_deg": 0.1}, _ALL),
        Variant("preset", f"{base.preset}: {_BASE}"),
        *(Variant("learner", name, {"learner": name, "learner_options": {}}, _LEARNING) for name in others),
        Variant("learner", "rbf over commands", {"learner": "rbf", "servo_inverse": False}, _LEARNING),
        *(
            Variant(group, name, {field: {**getattr(base, field), **option}}, controllers)
            for group, name, field, option, controllers in _OPTIONS
        ),
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
    """One object, some angles, every variant; care shows with an object that is hard to hold."""

    setting: Setting = field(default_factory=Setting)
    object: str = "box"
    angles_deg: tuple[float, ...] = (9.0, 19.0, 29.0)
    care_object: str = "tea_tin"
    """Of the group "care"."""
    care_angles_deg: tuple[float, ...] = (10.0, 20.0, 25.0)
    warm_up: int = 3
    groups: tuple[str, ...] = (
        "learner", "online learning", "model", "controller", "care", "preset", "disturbance", "dead zone",
    )  # fmt: skip

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

    def report(self, seeds: Sequence[int], results: Results[Record], folder: Path) -> Report:
        """Two tables for each group: where the turns end, and what a motion of the E-KM is worth."""
        shown = [make(group, seeds, results) for group in self.groups for make in (self.table, self.motions)]
        turned = dict.fromkeys(self._turned(group) for group in self.groups)
        summary = f"{self._answer(seeds, results)} One change at a time; {'; '.join(turned)}. "
        summary += f"{which_seeds(seeds)}{warmed_up(self.warm_up)}"
        title, names = (
            "Ablations: what each part is worth",
            {c for v in self._variants() for c in v.controllers},
        )
        explained = {name: line for name, line in LEGEND.items() if name in names}
        return Report(title, summary, shown, leading=2, legend=explained)

    def _turned(self, group: str) -> str:
        """What is done in a group."""
        object, angles = self._place(group)
        care = " in the group 'care'" if group == "care" else ""
        return f"{object_name(object)}, turns of {', '.join(f'{angle:g}' for angle in angles)} deg{care}"

    def _place(self, group: str) -> tuple[str, tuple[float, ...]]:
        """Object and angles of a group."""
        care = self.care_object, self.care_angles_deg
        return care if group == "care" else (self.object, self.angles_deg)

    def _variants(self) -> list[Variant]:
        return [variant for group in self.groups for variant in self.variants(group)]

    def _answer(self, seeds: Sequence[int], results: Results[Record]) -> str:
        """How the E-KM does as it is; what changes it, from enough seeds alone."""
        base = next((v for v in self._variants() if v.name == _BASE), None)
        if base is None:
            return ""
        mine = by_controller(self._records(base, seeds, results)).get("E-KM", [])
        if not mine:
            return "Nothing was grasped."
        lost, missed = sum(r.lost for r in mine), sum(r.not_reached for r in mine)
        text = f"The E-KM as it is ends {estimate(mine, steady_state_error):.2f} deg from the target; of "
        return (
            f"{text}{len(mine)} turns {lost} objects were lost and {missed} turns did not reach the target."
        )

    def _records(self, variant: Variant, seeds: Sequence[int], results: Results[Record]) -> list[Record]:
        return [r for name in self._jobs_of(variant, seeds) for r in results[name]]

    def table(self, group: str, seeds: Sequence[int], results: Results[Record]) -> Table:
        """Where the turns of the variants of one group end."""
        rows: list[list[Cell]] = []
        for variant in self.variants(group):
            turns = by_controller(self._records(variant, seeds, results))
            row: list[Cell] = [variant.name]
            row += [estimate(turns.get(name, []), steady_state_error) for name in _ALL]
            lost = [turns.get(name, []) for name in ("KM+I", "E-KM")]
            row += [rate(r.lost for r in mine) if mine else None for mine in lost]
            rows.append([*row, rate(r.not_reached for r in lost[-1]) if lost[-1] else None])
        columns = [group, *(f"{name} [deg]" for name in _ALL), "KM+I lost", "E-KM lost", "E-KM not reached"]
        note = (
            f"{object_name(self._place(group)[0])}, {len(seeds)} seeds. Steady-state error by the truth, "
            "lost objects with the whole angle; 95 % bootstrap intervals over seeds."
        )
        return Table(f"ablation_{group.replace(' ', '_')}", f"Ablation: {group}", columns, rows, note)

    def motions(self, group: str, seeds: Sequence[int], results: Results[Record]) -> Table:
        """What the motions of the E-KM are worth with the variants of one group."""
        rows: list[list[Cell]] = []
        for variant in self.variants(group):
            records = self._records(variant, seeds, results)
            mine = by_controller(records).get("E-KM")
            if mine:
                count, first = estimate(mine, lambda r: r.steps), estimate(mine, lambda r: r.first_step_deg)
                *predicted, _ = prediction_cells(records)
                rows.append([variant.name, count, first, *predicted, prediction_cells(records, "true_")[-1]])
        columns = [
            group, Column("motions", ".1f"), "first motion [deg]", "predicted by the KM [deg]",
            "by the E-KM [deg]", Column("ratio, true [%]", ".0f", percent=True),
        ]  # fmt: skip
        name = f"ablation_{group.replace(' ', '_')}_motions"
        note = (
            "Motions of a turn of the E-KM. First motion: by how much more or less it changed the error than "
            "it was to. Errors of one-step predictions on its motions, as measured, and E-KM over KM by the "
            "truth."
        )
        return Table(name, f"Ablation: {group}, motions of the E-KM", columns, rows, note)

    def _jobs_of(self, variant: Variant, seeds: Sequence[int]) -> dict[str, tuple[Generalize, str, int]]:
        object, angles = self._place(variant.group)
        one = variant.protocol(
            self.setting.replace(**variant.changes),
            objects=(object,),
            angles_deg=angles,
            warm_up=self.warm_up,
            long_step_deg=0.0,
            blind_deg=0.0,
            controllers=variant.controllers,
        )
        return {name: (one, controller, seed) for name, (_, controller, seed) in one.jobs(seeds).items()}


if __name__ == "__main__":
    run_study(Ablation(Setting(sensing=True)), __doc__)
