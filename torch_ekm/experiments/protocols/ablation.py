"""What each part is worth: one change at a time, on the same seeds and grasps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ...simulation import PRESETS
from ..config import Setting, digest
from ..learners import HAND_LEARNERS
from ..reporting.metrics import bootstrap_mean
from ..reporting.report import Table
from ..reporting.statistics import (
    Record,
    bootstrap_ratio,
    mean_prediction,
    paired_means,
    rate,
    select,
    steady_state_error,
)
from ..reporting.tables import estimate, percent, text
from .turning import GeneralizeConfig, generalize_session, object_name

_DEG = math.pi / 180
_BASE = "as it is"
_ALL = ("KM", "KM+I", "E-KM")

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
        "joint_noise",
        "position_noise",
        "rotation_noise",
        "force_noise",
        "force_offset",
        "force_hysteresis",
        "force_range",
    ),
}


@dataclass(frozen=True)
class Variant:
    """One change, and the controllers that it concerns."""

    group: str
    name: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Of the :class:`Setting`."""
    controllers: tuple[str, ...] = ("KM", "E-KM")


@dataclass(frozen=True)
class AblationConfig:
    """One object, some angles, every variant."""

    setting: Setting = field(default_factory=Setting)
    object: str = "box"
    angles_deg: tuple[float, ...] = (9.0, 19.0, 29.0)
    warm_up: int = 3
    groups: tuple[str, ...] = (
        "learner", "online learning", "model", "controller", "preset", "disturbance", "dead zone",
    )  # fmt: skip


def variants(config: AblationConfig) -> list[Variant]:
    """All variants of the chosen groups; each group begins with the unchanged setting."""
    base = config.setting
    found = [Variant("learner", _BASE)]
    found += [
        Variant("learner", name, {"learner": name, "learner_options": {}}, ("E-KM",))
        for name in HAND_LEARNERS
        if name != base.learner
    ]
    found.append(Variant("online learning", _BASE))
    for name, option in (
        ("no robust update", {"robust": None}),
        ("no forgetting", {"forgetting_factor": 1.0}),
    ):
        options = {**base.learner_options, **option}
        found.append(Variant("online learning", name, {"learner_options": options}, ("E-KM",)))
    for capacity in (15, 30, 120):
        name = f"{capacity} basis points"
        found.append(Variant("online learning", name, {"capacity": capacity}, ("E-KM",)))
    found.append(Variant("model", _BASE))
    for name, option in (
        ("no geometric stiffness", {"hand_stiffness": False, "object_stiffness": False}),
        ("no rolling", {"rolling": False}),
        ("rigid actuators", {"actuator_compliance": False}),
    ):
        found.append(Variant("model", name, {"model": {**base.model, **option}}))
    found.append(Variant("controller", _BASE))
    for name, option, who in (
        ("gain 1 near the goal", {"LimitingFunction.gain": 1.0}, _ALL),
        ("gain 0.6 near the goal", {"LimitingFunction.gain": 0.6}, _ALL),
        ("steps of 1.5 deg", {"LimitingFunction.step": 1.5 * _DEG}, _ALL),
        (
            "steps of 6 deg, 2 mm",
            {"LimitingFunction.step": 6 * _DEG, "LimitingFunction.contact_travel": 2e-3},
            _ALL,
        ),
        ("actuators cut at 6 deg", {"ActuatorLimit.step": 6 * _DEG, "JointLimit.horizon": 6 * _DEG}, _ALL),
        ("uncertainty in the cost", {"UncertaintyTask.weight": 1.0}, ("E-KM",)),
        ("rows for the friction margin", {"FrictionMarginLimit.minimum": 0.5}, _ALL),
    ):
        found.append(Variant("controller", name, {"control": {**base.control, **option}}, who))
    found.append(Variant("preset", f"{base.preset}: {_BASE}"))
    for preset in PRESETS:
        if preset != base.preset:
            found.append(Variant("preset", preset, {"preset": preset}, _ALL))
    nominal = dataclasses.asdict(PRESETS["nominal"])
    for name, fields in DISTURBANCES.items():
        plant = {key: nominal[key] for key in fields}
        changes = {"preset": "none", "plant": plant}
        found.append(Variant("disturbance", name, changes, _ALL))
    for size in (0.0, 0.5, 0.9, 1.3, 1.7):
        plant = {**base.plant, "dead_zone": size * _DEG}
        found.append(Variant("dead zone", f"{size:g} deg", {"plant": plant}, _ALL))
    return [variant for variant in found if variant.group in config.groups]


def ablation_jobs(config: AblationConfig, seeds: tuple[int, ...]) -> dict[str, tuple[Any, ...]]:
    """One job for each seed, variant and controller; variants that are alike share their jobs."""
    jobs: dict[str, tuple[Any, ...]] = {}
    for variant in variants(config):
        jobs.update(_jobs_of(config, variant, seeds))
    return jobs


def ablation_tables(
    config: AblationConfig, seeds: tuple[int, ...], results: Mapping[str, list[Record]]
) -> list[Table]:
    """One table for each group."""
    tables = []
    for group in config.groups:
        rows = []
        for variant in variants(config):
            if variant.group == group:
                names = _jobs_of(config, variant, seeds)
                rows.append(_row(variant, [r for name in names for r in results[name]]))
        header = [
            group, "steady-state error KM", "KM+I", "E-KM", "prediction KM", "E-KM", "E-KM:KM [%]",
            "E-KM:KM, true [%]", "lost: KM", "E-KM",
        ]  # fmt: skip
        note = (
            f"{object_name(config.object)}, {', '.join(f'{a:g}' for a in config.angles_deg)} deg, "
            f"{len(seeds)} seeds. Steady-state error by the truth, lost objects with the whole angle; "
            "one-step prediction error on the E-KM's own motions; both in degrees with 95 % bootstrap "
            "intervals over seeds."
        )
        tables.append(Table(f"ablation_{group.replace(' ', '_')}", f"Ablation: {group}", header, rows, note))
    return tables


def _row(variant: Variant, records: list[Record]) -> list[str]:
    by = {name: select(records, controller=name, kind="turn") for name in ("KM", "KM+I", "E-KM")}
    row = [variant.name, *(text(estimate(by[name], steady_state_error)) for name in ("KM", "KM+I", "E-KM"))]
    mine = [r for r in by["E-KM"] if r["prediction_ekm_deg"]]
    if mine:
        ours, theirs = paired_means(mine, mine, mean_prediction("ekm"), mean_prediction("km"))
        true = paired_means(mine, mine, mean_prediction("true_ekm"), mean_prediction("true_km"))
        row += [text(bootstrap_mean(theirs)), text(bootstrap_mean(ours))]
        row += [percent(bootstrap_ratio(ours, theirs)), percent(bootstrap_ratio(*true))]
    else:
        row += ["-"] * 4
    return row + [str(rate(r["lost"] for r in by[name])) if by[name] else "-" for name in ("KM", "E-KM")]


def _jobs_of(config: AblationConfig, variant: Variant, seeds: tuple[int, ...]) -> dict[str, tuple[Any, ...]]:
    one = GeneralizeConfig(
        config.setting.replace(**variant.changes),
        objects=(config.object,),
        angles_deg=config.angles_deg,
        warm_up=config.warm_up,
        long_step_deg=0.0,
        blind_deg=0.0,
    )
    stem = f"ablation_{digest(one.setting, one.objects, one)}"
    return {
        f"{stem}_{name}_{seed}": (one, config.object, name, seed)
        for seed in seeds
        for name in variant.controllers
    }


#: What :func:`run_jobs` runs.
ablation_session = generalize_session

__all__ = [
    "DISTURBANCES",
    "AblationConfig",
    "Variant",
    "ablation_jobs",
    "ablation_session",
    "ablation_tables",
    "variants",
]
