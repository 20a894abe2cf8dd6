"""What each part is worth: one change at a time, on the same seeds and grasps.

    python benchmarks/studies/ablation.py --seeds 1000:1010 --out FOLDER

With 20 seeds, 3140 sessions of 3 to 6 turns: 5 h on two cores. Interrupted, it goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from oracle import TURNS_ALONE, OracleGeneralize
from run_study import run_study

from torch_ekm.control import (
    ActuatorLimit,
    Caution,
    GripForceTask,
    JointLimit,
    LimitingFunction,
    PaceOptions,
    Safety,
    StepBound,
    TrustRegion,
)
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
from torch_ekm.model import ModelOptions
from torch_ekm.simulation import PRESETS, PlantParameters

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
    protocol: type[Generalize] = Generalize


def _part(kind: type, **figures: Any) -> Callable[[Setting], dict[str, Any]]:
    """Figures of one part of a setting, whichever field holds it; a limit that is not there is added."""

    def change(base: Setting) -> dict[str, Any]:
        for name, held in {**vars(base), "plant": base.parameters}.items():
            if isinstance(held, kind):
                return {name: replace(held, **figures)}
            if isinstance(held, tuple) and any(isinstance(one, kind) for one in held):
                made = (replace(one, **figures) if isinstance(one, kind) else one for one in held)
                return {name: tuple(made)}
            for inner, one in vars(held).items() if isinstance(held, PaceOptions | Safety) else ():
                if isinstance(one, kind):
                    return {name: replace(held, **{inner: replace(one, **figures)})}
        return {"limits": (*base.limits, kind(**figures))}

    return change


def _learner(**options: Any) -> Callable[[Setting], dict[str, Any]]:
    return lambda base: {"learner_options": {**base.learner_options, **options}}


def _short_actuator_steps(base: Setting) -> dict[str, Any]:
    base = base.replace(**_part(ActuatorLimit, step=6 * _DEG)(base))
    return _part(JointLimit, horizon=6 * _DEG)(base)


_NO_WAY_BACK = {"off_rotation": math.inf, "link_gap": -math.inf, "way_back": 0}
#: Group, name, what is changed in the setting, and the controllers that it concerns.
_OPTIONS: list[tuple[str, str, Callable[[Setting], dict[str, Any]], tuple[str, ...]]] = [
    ("online learning", "no robust update", _learner(robust=None), _LEARNING),
    ("online learning", "no forgetting", _learner(forgetting_factor=1.0), _LEARNING),
    ("model", "no rolling", _part(ModelOptions, rolling=False), _BOTH),
    ("model", "rigid actuators", _part(ModelOptions, actuator_compliance=False), _BOTH),
    ("controller", "gain 1 near the goal", _part(LimitingFunction, gain=1.0), _ALL),
    ("controller", "gain 0.6 near the goal", _part(LimitingFunction, gain=0.6), _ALL),
    ("controller", "steps of 1.5 deg", _part(LimitingFunction, step=1.5 * _DEG), _ALL),
    (
        "controller", "steps of 6 deg, 2 mm",
        _part(LimitingFunction, step=6 * _DEG, contact_travel=2e-3), _ALL,
    ),
    ("controller", "actuators cut at 6 deg", _short_actuator_steps, _ALL),
    ("care", "a grip of 5 N for every object", _part(GripForceTask, force=5.0), _ALL),
    ("care", "the pace fixed", _part(TrustRegion, start=1.0, smallest=1.0, largest=1.0), _LEARNING),
    ("care", "steps cut by the grip alone", _part(StepBound, least=math.inf), _ALL),
    ("care", "large steps with uneven forces", _part(StepBound, even=1e-3), _LEARNING),
    ("care", "no second look", _part(Caution, looks=0), _ALL),
    ("care", "no way back", _part(Caution, **_NO_WAY_BACK), _ALL),
    *(
        ("dead zone", f"{x:g} deg", _part(PlantParameters, dead_zone=x * _DEG), _ALL)
        for x in (0, 0.5, 0.9, 1.3, 1.7)
    ),
]  # fmt: skip


def variants(base: Setting) -> list[Variant]:
    """All variants of a setting; most groups begin with the unchanged one."""
    nominal, exact = vars(PRESETS["nominal"]), PRESETS["none"]
    rule = replace(base.safety.rule, tolerance=0.1 * _DEG)
    finer = {"frames": 6, "safety": replace(base.safety, rule=rule)}
    others = [name for name in LEARNERS if name != base.learner]
    plants = {
        name: exact.replace(**{key: nominal[key] for key in keys}) for name, keys in DISTURBANCES.items()
    }
    return [
        *(Variant(group, _BASE) for group in ("learner", "online learning", "model")),
        *(Variant(group, _BASE, controllers=_ALL) for group in ("controller", "care")),
        Variant("care", "oracle: true model, pose and forces", {}, ("KM+S",), OracleGeneralize),
        Variant("care", "pose and joints from six readings at rest", {"frames": 6}, _ALL),
        Variant("care", "the same, to a tolerance of 0.1 deg", finer, _ALL),
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

    def report(self, seeds: Sequence[int], trials: DataFrame, folder: Path) -> Report:
        """Two tables for each group: where the turns end, and what a motion of the E-KM is worth."""
        shown = [make(group, seeds, trials) for group in self.groups for make in (self.table, self.motions)]
        turned = dict.fromkeys(self._turned(group) for group in self.groups)
        summary = f"{self._answer(seeds, trials)} One change at a time; {'; '.join(turned)}. "
        summary += f"{which_seeds(seeds)}{warmed_up(self.warm_up)}"
        title = "Ablations: the effect of each part"
        names = {c for v in self._variants() for c in v.controllers}
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
            f"{object_name(self._place(group)[0])}, {len(seeds)} seeds. Steady-state error by the truth, "
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
        object, angles = self._place(variant.group)
        one = variant.protocol(
            self.setting.replace(**variant.changes),
            objects=(object,),
            angles_deg=angles,
            warm_up=self.warm_up,
            controllers=variant.controllers,
            **TURNS_ALONE,
        )
        return {name: (one, controller, seed) for name, (_, controller, seed) in one.jobs(seeds).items()}


if __name__ == "__main__":
    run_study(Ablation(Setting(sensing=True)), __doc__)
