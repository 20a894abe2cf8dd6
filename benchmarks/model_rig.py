"""A simulated hand without an engine: a kinematic model of its true figures moves it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torch_ekm.control import ModelHand
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.runner import Bench
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel
from torch_ekm.simulation import PRESETS, PlantParameters, SimulatedHand, preset
from torch_ekm.simulation.mechanism.servo import Servo
from torch_ekm.simulation.sensors import TimedState
from torch_ekm.typing import Array

#: Figures of a hand for training, each uniform between the presets "none" and "hostile".
DRAWN = (
    "moment_arm", "spring", "servo_stiffness", "friction", "mass", "actuator_bias", "actuator_error",
    "dead_zone", "backlash",
)  # fmt: skip


class ModelRig:
    """The hand of a :class:`SimulatedHand` as a kinematic model of its true figures moves it, no engine.

    Motions are those of :class:`ModelHand`: contacts stick, slide, open and close. Servos and sensors are
    the simulation's; joint friction, weight of the links and creep are left out.
    """

    def __init__(self, plant: SimulatedHand) -> None:
        hand, obj = plant.true_descriptions()
        self._model, self._parameters = KinematicModel(hand, obj), plant.parameters
        self.scene, self.transmission = self, self  # one object stands for the parts of a simulated hand
        limits = plant.hand.actuator_lower, plant.hand.actuator_upper
        self.servo = Servo(*limits, plant.parameters, plant.config.relative_to)

    def grasp(self, plan: Any) -> None:
        """In the planned equilibrium."""
        state = GraspState(*map(torch.tensor, (plan.q, plan.position, plan.rotation)))
        along = -(plan.forces * plan.normals).sum(-1)
        force = torch.zeros(len(self._model.hand.pads), dtype=torch.float64)
        force[self._model.hand.pad_indices(plan.pads)] = torch.from_numpy(along)
        self.servo.place(plan.motor)
        self._waited = 0.0
        self._moves = ModelHand(self._model, state, torch.tensor(plan.motor), force)

    def follow(self, goals: Array, times: Array, frame: Any = None) -> None:
        """The tendons follow the motors, but for the play; nothing is seen on the way."""
        for goal in goals:
            before = self.servo.output
            self._moves.command(torch.from_numpy(self.servo.move_to(goal) - before))

    def wait_for_frame(self) -> None:
        """A hand without dynamics stands."""
        self._waited += 1 / self._parameters.frame_rate

    @property
    def state(self) -> TimedState:
        return TimedState(self.time, self.q, *self.object_pose)

    def actuator_torque(self, q: Array, output: Array) -> Array:
        """Of no interest here."""
        return np.zeros_like(output)

    @property
    def q(self) -> Array:
        return self._moves.state.q.numpy()

    @property
    def object_pose(self) -> tuple[Array, Array]:
        return self._moves.state.position.numpy(), self._moves.state.rotation.numpy()

    @property
    def normal(self) -> Array:
        return self._moves.force.numpy()

    @property
    def fingers(self) -> int:
        """Pads that bear; none of a grasp that has failed."""
        return 0 if self._moves.failure else int((self.normal > 0).sum())

    @property
    def time(self) -> float:
        return 0.3 * self._moves.time + self._waited


class ModelBench(Bench):
    """A :class:`Bench` whose simulated hand is a kinematic model."""

    def __init__(self, setting: Setting, object: str, controller: str) -> None:
        super().__init__(setting, object, controller)
        self.hand._rig = ModelRig(self.hand)

    def grasp_again(self) -> GraspState:
        """In the same place, for planning a pinch takes as long as a turn."""
        self.hand._rig.grasp(self.hand.plan)
        self.hand._sensors.forget()
        return self.plant.observe().state


def drawn_plant(draw: np.random.Generator) -> PlantParameters:
    """A used hand: each figure of DRAWN between those of "none" and "hostile", sensors as in "nominal"."""
    new, old = PRESETS["none"], PRESETS["hostile"]
    figures = {name: draw.uniform(*sorted((getattr(new, name), getattr(old, name)))) for name in DRAWN}
    return preset("nominal").replace(**figures, hardware_seed=int(draw.integers(2**31)))
