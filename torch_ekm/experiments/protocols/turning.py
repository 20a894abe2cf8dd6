"""The paper's two experiments: online manipulation, and generalisation to other objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...exceptions import ParameterError, UnknownNameError
from ...simulation import Change, Tug
from ..config import CONTROLLERS, Setting, digest
from ..runner import Bench, Record
from .demo import TABLE_I

#: Angles for objects that Table I does not know [deg].
OTHER_ANGLES = (5.0, 10.0, 15.0, 20.0, 25.0)
_FIRST_WARM_UP = 1000  # number of the first training grasp: never one that is tested
_PROBES = 2000  # and of the first grasp for probes


@dataclass(frozen=True)
class OnlineConfig:
    """Section IV.B: random grasps and rotations of one object, with things that go wrong on the way.

    Trials count from 1, as in the paper.

    Raises:
        ParameterError: an interval or an index outside its range.
    """

    setting: Setting = field(default_factory=Setting)
    object: str = "toothpaste"
    trials: int = 45
    angles_deg: tuple[float, float] = (6.0, 24.0)
    """Rotations are drawn from this interval."""
    dislocations: tuple[int, ...] = (20, 44)
    """In these trials somebody knocks at the object after its third motion."""
    knock: tuple[float, float, float] = (0.0, 0.10, 0.0)
    """Torque of the knock [N m], hand frame, for 50 ms: it turns the tube by 5 to 10 deg."""
    tendons_replaced: int = 31
    """Before this trial the tendons are replaced (0: never)."""
    new_tendons: Mapping[str, float] = field(
        default_factory=lambda: {"moment_arm": 1.15, "servo_stiffness": 0.8}
    )
    """What the plant then is: tighter tendons, less stretch."""

    def __post_init__(self) -> None:
        low, high = self.angles_deg
        if not 0 < low <= high < 180:
            raise ParameterError("angles_deg", self.angles_deg, "0 < low <= high < 180 deg")
        if self.trials < 1:
            raise ParameterError("trials", self.trials, "at least 1")

    @property
    def events(self) -> tuple[int, ...]:
        """Trials in which something happens, those that take place."""
        replaced = (self.tendons_replaced,) if self.tendons_replaced else ()
        return tuple(sorted(t for t in (*self.dislocations, *replaced) if t <= self.trials))


@dataclass(frozen=True)
class GeneralizeConfig:
    """Section IV.C: several objects, each turned by the angles of Table I.

    Each E-KM begins empty with every object and seed and has ``warm_up`` turns, on grasps that are
    not tested, before it is measured; it goes on learning while it is.

    Raises:
        ParameterError: no object, or an angle that is no rotation.
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

    def __post_init__(self) -> None:
        if not self.objects:
            raise ParameterError("objects", self.objects, "at least one object")
        for name in self.objects:
            if not all(0 < abs(angle) < 180 for angle in self.angles_of(name)):
                raise ParameterError("angles_deg", self.angles_deg, "angles between 0 and 180 deg")

    def angles_of(self, object: str) -> tuple[float, ...]:
        """Rotations of one object [deg]."""
        return self.angles_deg if self.angles_deg is not None else TABLE_I.get(object, OTHER_ANGLES)


def online_session(config: OnlineConfig, controller: str, seed: int) -> list[Record]:
    """All trials of one seed, in order; an E-KM starts empty and keeps what it learns."""
    _check(controller)
    angles = np.random.default_rng(seed).uniform(*config.angles_deg, size=config.trials)
    bench = Bench(config.setting.hardware_instance(seed), config.object, controller)
    records = []
    for trial, angle in enumerate(angles.tolist(), start=1):
        if trial == config.tendons_replaced:
            Change(0, config.new_tendons).happen(bench.hand)
        events = (Tug(at=3, torque=config.knock),) if trial in config.dislocations else ()
        record = bench.trial(seed, trial, angle, events=events)
        records.append({**record, "object": config.object, "kind": "turn"})
    bench.close()
    return records


def generalize_session(config: GeneralizeConfig, object: str, controller: str, seed: int) -> list[Record]:
    """Warm-up (E-KM only), all angles, then the probes, with one object and one seed."""
    _check(controller)
    bench = Bench(config.setting.hardware_instance(seed), object, controller)
    angles = config.angles_of(object)
    about = {"object": object_name(object)}
    records: list[Record] = []
    middle = float(np.median(angles))
    if bench.learns:
        for k in range(config.warm_up):
            record = bench.trial(seed, _FIRST_WARM_UP + k, middle)
            records.append({**record, **about, "kind": "warm-up"})
    for trial, angle in enumerate(angles):
        records.append({**bench.trial(seed, trial, angle), **about, "kind": "turn"})
    if config.long_step_deg:
        for k in range(2):
            record = bench.long_step(seed, _PROBES + k, config.long_step_deg)
            records.append({**record, **about, "kind": "long step"})
    if config.blind_deg:
        record = bench.trial(
            seed, _PROBES + 10, max(middle, config.blind_deg + 3), learn=False, blind_deg=config.blind_deg
        )
        records.append({**record, **about, "kind": "camera off"})
    bench.close()
    return records


def online_jobs(config: OnlineConfig, seeds: tuple[int, ...]) -> dict[str, tuple[Any, ...]]:
    """One job for each seed and controller; the name holds all that decides its result."""
    stem = f"online_{digest(config.setting, (config.object,), config)}"
    return {f"{stem}_{name}_{seed}": (config, name, seed) for seed in seeds for name in CONTROLLERS}


def generalize_jobs(config: GeneralizeConfig, seeds: tuple[int, ...]) -> dict[str, tuple[Any, ...]]:
    """One job for each seed, object and controller."""
    # a job does not depend on which other objects there are
    alone = dataclasses.replace(config, objects=("any",))
    own = {item: digest(config.setting, (item,), alone, config.angles_of(item)) for item in config.objects}
    return {
        f"generalize_{own[item]}_{object_name(item)}_{name}_{seed}": (config, item, name, seed)
        for seed in seeds
        for item in config.objects
        for name in CONTROLLERS
    }


def object_name(object: str) -> str:
    """Short name of an object given by name or path."""
    return Path(object).stem if object.endswith(".urdf") else object


def _check(controller: str) -> None:
    if controller not in CONTROLLERS:
        raise UnknownNameError("controller", controller, CONTROLLERS)
