"""What the experiments share: hand, plant, model, learner and the rule by which all controllers stop."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..control import ControllerOptions, StoppingRule
from ..description import HandDescription, list_hands
from ..exceptions import ParameterError, UnknownNameError
from ..model import ModelOptions
from ..simulation import PlantConfig, PlantParameters, severity
from .demo import fixed_actuators
from .learners import LEARNERS

_DEG = math.pi / 180

#: The controllers that are compared on the same seeds, grasps, limits and stopping rule. "+I": the
#: increments accumulate on the set-point instead of the encoder, an integrator that learns nothing.
CONTROLLERS = ("KM", "KM+I", "E-KM", "E-KM+I")


@dataclass(frozen=True)
class Setting:
    """One way to run a manipulation; plain figures only, so that it can be written down and compared.

    The mappings change single figures of the classes they are named after.

    Raises:
        UnknownNameError: no such hand, severity or learner; the message lists them.
        ParameterError: a figure outside its range.
    """

    hand: str = "icub_right"
    severity: str = "nominal"
    plant: Mapping[str, Any] = field(default_factory=dict)
    """Changes of the severity's :class:`PlantParameters`."""
    grasp: Mapping[str, Any] = field(default_factory=dict)
    """Changes of :class:`PlantConfig`."""
    model: Mapping[str, Any] = field(default_factory=dict)
    """Changes of :class:`ModelOptions`."""
    control: Mapping[str, Any] = field(default_factory=dict)
    """Changes of :class:`ControllerOptions`."""
    learner: str = "rbf"
    learner_options: Mapping[str, Any] = field(default_factory=dict)
    capacity: int = 60
    sensing: bool = False
    """Poses from rendered camera images and joint angles from Hall counts, not truth plus noise."""
    tolerance_deg: float = 0.25
    max_steps: int = 60

    def __post_init__(self) -> None:
        if self.hand not in list_hands() and not Path(self.hand).exists():
            raise UnknownNameError("hand", self.hand, list_hands())
        if self.learner not in LEARNERS:
            raise UnknownNameError("learner", self.learner, LEARNERS)
        for name in ("capacity", "tolerance_deg", "max_steps"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "positive")
        self.parameters()
        self.plant_config("KM")
        self.model_options()

    def parameters(self) -> PlantParameters:
        """The plant's."""
        return severity(self.severity).replace(**self.plant)

    def specimen(self, seed: int) -> Setting:
        """The same with another specimen of the hand (signs and sizes of its constant errors)."""
        return self.replace(plant={"hardware_seed": seed, **self.plant})

    def plant_config(self, controller: str) -> PlantConfig:
        """The position controller as ``controller`` uses it, and the grasp."""
        if controller not in CONTROLLERS:
            raise UnknownNameError("controller", controller, CONTROLLERS)
        relative_to = "setpoint" if controller.endswith("+I") else "encoder"
        return _changed(PlantConfig(relative_to=relative_to), "grasp", self.grasp)

    def model_options(self) -> ModelOptions:
        """The kinematic model's."""
        gravity = self.plant_config("KM").gravity
        return _changed(ModelOptions(gravity=gravity), "model", self.model)

    def controller_options(self, hand: HandDescription) -> ControllerOptions:
        """The same for every controller."""
        options = ControllerOptions(fixed_actuators=fixed_actuators(hand))
        return _changed(options, "control", self.control)

    def stopping_rule(self) -> StoppingRule:
        """The same for every controller."""
        return StoppingRule(
            tolerance=self.tolerance_deg * _DEG, stall_progress=0.1 * _DEG, max_steps=self.max_steps
        )

    def figures(self) -> dict[str, Any]:
        """All figures of plant, model, controller and stopping rule, defaults included."""
        parts = {
            "plant": self.parameters(),
            "plant_config": self.plant_config("KM"),
            "model": self.model_options(),
            "controller": _changed(ControllerOptions(), "control", self.control),
            "stopping_rule": self.stopping_rule(),
        }
        return {name: dataclasses.asdict(part) for name, part in parts.items()}

    def replace(self, **changes: Any) -> Setting:
        """A copy with some figures changed."""
        return dataclasses.replace(self, **changes)


def digest(config: Any) -> str:
    """Ten letters that change with any figure of an experiment: results are kept under them.

    The defaults of the classes that its :class:`Setting` changes count, too: a version of the package
    with other defaults does not take up the results of this one.
    """
    figures = [dataclasses.asdict(config), config.setting.figures()]
    text = json.dumps(figures, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _changed(options: Any, name: str, changes: Mapping[str, Any]) -> Any:
    known = {item.name for item in dataclasses.fields(options)}
    for key in changes:
        if key not in known:
            raise ParameterError(name, key, f"one of {', '.join(sorted(known))}")
    return dataclasses.replace(options, **changes)
