"""Settings of experiments: hand, plant, model, learner and the rule by which all controllers stop."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .._checks import check_count, check_kind
from .._recorded import describe
from ..control import (
    DEFAULT_LIMITS,
    DEFAULT_TASKS,
    Limit,
    LimitingFunction,
    Planner,
    Safety,
    StepBound,
    Task,
    WholeTurn,
)
from ..description import list_hands
from ..description.registry import file_digests
from ..exceptions import UnknownNameError
from ..model import ModelOptions
from ..simulation import ENGINES, PlantConfig, PlantParameters, preset
from .learners import DEFAULT_LEARNER, HAND_LEARNERS, make_learner

#: The controllers that are compared on the same seeds, grasps, limits and stopping rule. "+I" is integral
#: action: the increments accumulate on the set-point instead of the encoder, which learns nothing. "+S" is
#: the servo inverse, on which the E-KM stands, too; the E-KM also learns the hand, and plans whole turns.
CONTROLLERS = ("KM", "KM+I", "KM+S", "E-KM")
#: Seeds from here on are never used for tuning.
FIRST_REPORTED = 1000


@dataclass(frozen=True)
class Setting:
    """One way to run a manipulation: the figures of plant, grasp, model, controller and learner, which can be
    written down and compared.

    Raises:
        UnknownNameError: no such hand, preset, engine or learner; the message lists them.
        ParameterError: a figure outside its range.
    """

    hand: str = "icub_right"
    preset: str = "nominal"
    plant: PlantParameters | None = None
    """In place of the preset's."""
    config: PlantConfig = field(default_factory=PlantConfig)
    """How the simulated hand is run: gravity, grasps."""
    engine: str = "sapien"
    """The physics of the simulated hand; or "mujoco"."""
    model: ModelOptions = field(default_factory=ModelOptions)
    tasks: tuple[Task, ...] = DEFAULT_TASKS
    limits: tuple[Limit, ...] = DEFAULT_LIMITS
    limiting: LimitingFunction = field(default_factory=LimitingFunction)
    bound: StepBound | None = field(default_factory=StepBound)
    planner: Planner | None = None
    """None: as a :class:`~torch_ekm.control.ClosedLoop` has it."""
    safety: Safety = field(default_factory=Safety)
    servo_inverse: bool = True
    """The E-KM commands through one; without it the dead zone is learned together with the hand."""
    adapts: bool = True
    """f of the E-KM follows the figures of the hand as they are learned; else, and where no fingertip
    measures, its description."""
    learner: str = DEFAULT_LEARNER
    learner_options: Mapping[str, Any] = field(default_factory=dict)
    capacity: int = 60
    sensing: bool = False
    """Poses from rendered camera images and joint angles from Hall counts, not truth plus noise."""
    frames: int = 1
    """Readings at rest after each motion; their mean is taken (:class:`~torch_ekm.plant.FramesAtRest`)."""

    def __post_init__(self) -> None:
        if self.hand not in list_hands() and not Path(self.hand).exists():
            raise UnknownNameError("hand", self.hand, (*list_hands(), "a path to a .urdf file"))
        for name, known in (("learner", HAND_LEARNERS), ("engine", ENGINES)):
            if getattr(self, name) not in known:
                raise UnknownNameError(name, getattr(self, name), known)
        for name in ("capacity", "frames"):
            check_count(name, getattr(self, name))
        kinds = {"plant": PlantParameters, "config": PlantConfig, "model": ModelOptions}
        kinds |= {"limiting": LimitingFunction, "safety": Safety}
        for name, kind in kinds.items():
            check_kind(name, self.parameters if name == "plant" else getattr(self, name), kind)

    def __str__(self) -> str:
        seen = "camera images and Hall counts" if self.sensing else "true poses plus noise"
        engine = ENGINES[self.engine]
        return f"Hand {Path(self.hand).stem} simulated in {engine}, preset {self.preset}, {seen}"

    @property
    def parameters(self) -> PlantParameters:
        """Figures of the simulated plant: ``plant``, or else those of the preset."""
        return preset(self.preset) if self.plant is None else self.plant

    @property
    def follows(self) -> bool:
        """f of the E-KM follows the figures of the hand. Motions of other figures than those of the
        forces let a grip slide where no pad measures."""
        return self.adapts and self.parameters.force_sensors

    def hardware_instance(self, seed: int) -> Setting:
        """The same with another instance of the hand (signs and sizes of its constant errors)."""
        return self.replace(plant=self.parameters.replace(hardware_seed=seed))

    def plant_config(self, controller: str) -> PlantConfig:
        """The position controller as ``controller`` uses it, and the grasp.

        Raises:
            UnknownNameError: no such controller; the message lists them.
        """
        if controller not in CONTROLLERS:
            raise UnknownNameError("controller", controller, CONTROLLERS)
        relative_to = "setpoint" if controller.endswith("+I") else "encoder"
        return dataclasses.replace(self.config, relative_to=relative_to)

    def figures(self) -> dict[str, Any]:
        """All figures of plant, model, controller and learner, defaults included."""
        parts = *self.tasks, *self.limits, self.limiting, self.bound, self.planner or WholeTurn(), self.safety
        return {
            "plant": dataclasses.asdict(self.parameters),
            "plant_config": dataclasses.asdict(self.config),
            "model": dataclasses.asdict(self.model),
            "controller": [repr(part) for part in parts],
            "learner": describe(make_learner(self.learner, 1, 1, self.capacity, **self.learner_options)),
        }

    def replace(self, **changes: Any) -> Setting:
        """A copy in which the named fields have other values, checked like a new setting."""
        return dataclasses.replace(self, **changes)


def digest(setting: Setting, objects: Iterable[str | Path], *more: Any) -> str:
    """Ten letters that change with any figure of an experiment: results are kept under them.

    The defaults of the classes that the setting changes count, too, and what is in the files of the hand and
    the objects (names or paths): neither a version of the package with other defaults nor an object that was
    corrected takes up old results. ``more`` decides the results as well.
    """
    contents = list(file_digests(setting.hand, objects).values())
    figures = [dataclasses.asdict(setting), setting.figures(), contents, more]
    text = json.dumps(figures, sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _plain(item: Any) -> Any:
    return vars(item) if dataclasses.is_dataclass(item) else str(item)


def object_name(object: str) -> str:
    """Short name of an object given by name or path."""
    return Path(object).stem if object.endswith(".urdf") else object
