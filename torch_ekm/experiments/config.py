"""What the experiments share: hand, plant, model, learner and the rule by which all controllers stop."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..control import (
    DEFAULT_LIMITS,
    DEFAULT_TASKS,
    ActuatorLimit,
    Caution,
    EffortTask,
    FocusTask,
    FrictionMarginLimit,
    GripForceTask,
    JointLimit,
    LimitingFunction,
    NormalForceLimit,
    OffAxisTask,
    StepBound,
    StoppingRule,
)
from ..description import file_digests, list_hands
from ..enhanced import TrustOptions, TrustRegion
from ..exceptions import ParameterError, UnknownNameError
from ..model import ModelOptions
from ..simulation import PlantConfig, PlantParameters, preset
from .learners import DEFAULT_LEARNER, LEARNERS, learner_figures

_DEG = math.pi / 180

#: The controllers that are compared on the same seeds, grasps, limits and stopping rule. "+I" is integral
#: action: the increments accumulate on the set-point instead of the encoder, which learns nothing. "+S" is
#: the servo inverse, on which the E-KM stands, too; the E-KM also learns the hand, and paces itself.
CONTROLLERS = ("KM", "KM+I", "KM+S", "E-KM")
#: Seeds from here on are never used for tuning.
FIRST_REPORTED = 1000

#: Parts of a controller in the order in which they are summed.
_TASKS = (EffortTask, OffAxisTask, GripForceTask, FocusTask)
_LIMITS = (ActuatorLimit, NormalForceLimit, FrictionMarginLimit, JointLimit)
#: How far a step goes, and what is done when it goes wrong.
_PACE = (LimitingFunction, StepBound, Caution, TrustRegion)


@dataclass(frozen=True)
class Setting:
    """One way to run a manipulation; plain figures only, so that it can be written down and compared.

    The mappings change single figures of the classes they are named after.

    Raises:
        UnknownNameError: no such hand, preset or learner; the message lists them.
        ParameterError: a figure outside its range.
    """

    hand: str = "icub_right"
    preset: str = "nominal"
    plant: Mapping[str, Any] = field(default_factory=dict)
    """Changes of the preset's :class:`PlantParameters`."""
    grasp: Mapping[str, Any] = field(default_factory=dict)
    """Changes of :class:`PlantConfig`."""
    model: Mapping[str, Any] = field(default_factory=dict)
    """Changes of :class:`ModelOptions`."""
    control: Mapping[str, Any] = field(default_factory=dict)
    """Changes of the controller's parts, ``{"OffAxisTask.rotation_weight": 0.1}``; one that is not among the
    defaults is added (:mod:`~torch_ekm.control.tasks`, :mod:`~torch_ekm.control.limits`, and
    ``LimitingFunction``, ``StepBound``, ``Caution``, ``TrustRegion``)."""
    servo_inverse: bool = True
    """The E-KM commands through one; without it the dead zone is learned together with the hand."""
    learner: str = DEFAULT_LEARNER
    learner_options: Mapping[str, Any] = field(default_factory=dict)
    capacity: int = 60
    sensing: bool = False
    """Poses from rendered camera images and joint angles from Hall counts, not truth plus noise."""
    frames: int = 1
    """Readings at rest after each motion; their mean is taken (:class:`~torch_ekm.plant.FramesAtRest`)."""
    tolerance_deg: float = 0.25
    max_steps: int = 60

    def __post_init__(self) -> None:
        if self.hand not in list_hands() and not Path(self.hand).exists():
            raise UnknownNameError("hand", self.hand, (*list_hands(), "a path to a .urdf file"))
        if self.learner not in LEARNERS:
            raise UnknownNameError("learner", self.learner, LEARNERS)
        for name in ("capacity", "frames", "tolerance_deg", "max_steps"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "positive")
        self.parameters()
        self.plant_config("KM")
        self.model_options()
        self.controller_parts()

    def __str__(self) -> str:
        seen = "camera images and Hall counts" if self.sensing else "true poses plus noise"
        return f"Simulated hand {Path(self.hand).stem}, preset {self.preset}, {seen}"

    def parameters(self) -> PlantParameters:
        """The plant's."""
        return preset(self.preset).replace(**self.plant)

    def hardware_instance(self, seed: int) -> Setting:
        """The same with another instance of the hand (signs and sizes of its constant errors)."""
        return self.replace(plant={"hardware_seed": seed, **self.plant})

    def plant_config(self, controller: str) -> PlantConfig:
        """The position controller as ``controller`` uses it, and the grasp.

        Raises:
            UnknownNameError: no such controller; the message lists them.
        """
        if controller not in CONTROLLERS:
            raise UnknownNameError("controller", controller, CONTROLLERS)
        relative_to = "setpoint" if controller.endswith("+I") else "encoder"
        return _changed(PlantConfig(relative_to=relative_to), "grasp", self.grasp)

    def model_options(self) -> ModelOptions:
        """The kinematic model's."""
        return _changed(ModelOptions(), "model", self.model)

    def controller_parts(self) -> dict[str, Any]:
        """``tasks``, ``limits``, ``limiting``, ``bound``, of every :class:`LookAndMoveController`."""
        parts = self._parts()
        tasks, limits = (
            tuple(parts[kind.__name__] for kind in kinds if kind.__name__ in parts)
            for kinds in (_TASKS, _LIMITS)
        )
        pace = {"limiting": parts["LimitingFunction"], "bound": parts["StepBound"]}
        return {"tasks": tasks, "limits": limits, **pace}

    def caution(self) -> Caution:
        """The same for every controller."""
        return self._parts()["Caution"]

    def trust_region(self) -> TrustRegion:
        """Of an E-KM, with nothing known of the object."""
        return TrustRegion(self._parts()["TrustRegion"])

    def _parts(self) -> dict[str, Any]:
        defaults = (*DEFAULT_TASKS, *DEFAULT_LIMITS, LimitingFunction(), StepBound(), Caution())
        parts: dict[str, Any] = {type(part).__name__: part for part in defaults}
        parts["TrustRegion"] = TrustOptions()
        known = {kind.__name__: kind for kind in (*_TASKS, *_LIMITS, *_PACE)}
        for key, value in self.control.items():
            name, _, figure = key.partition(".")
            if name not in known:
                raise ParameterError("control", key, f"PART.FIGURE, the part one of {', '.join(known)}")
            part = parts[name] if name in parts else known[name]()
            parts[name] = _changed(part, f"control of {name}", {figure: value})
        return parts

    def stopping_rule(self) -> StoppingRule:
        """The same for every controller."""
        return StoppingRule(tolerance=self.tolerance_deg * _DEG, max_steps=self.max_steps)

    def figures(self) -> dict[str, Any]:
        """All figures of plant, model, controller, stopping rule and learner, defaults included."""
        return {
            "plant": dataclasses.asdict(self.parameters()),
            "plant_config": dataclasses.asdict(self.plant_config("KM")),
            "model": dataclasses.asdict(self.model_options()),
            "stopping_rule": dataclasses.asdict(self.stopping_rule()),
            "controller": {name: repr(part) for name, part in self._parts().items()},
            "learner": learner_figures(self.learner, self.capacity, **self.learner_options),
        }

    def replace(self, **changes: Any) -> Setting:
        """A copy with some figures changed."""
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


def _changed(options: Any, name: str, changes: Mapping[str, Any]) -> Any:
    known = {item.name for item in dataclasses.fields(options)}
    for key in changes:
        if key not in known:
            raise ParameterError(name, key, f"one of {', '.join(sorted(known))}")
    return dataclasses.replace(options, **changes)
