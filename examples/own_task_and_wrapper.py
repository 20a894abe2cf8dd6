"""A task, a limit, a planner and a plant wrapper of your own: python examples/own_task_and_wrapper.py.

A task adds squares to the controller's program, a limit adds inequalities; both are rows in the motors'
increments u [rad]. A planner decides on the movements. A wrapper changes what the loop sees of a plant, or
what it commands.
"""

import dataclasses
import math

import torch

from torch_ekm.control import (
    DEFAULT_LIMITS,
    DEFAULT_TASKS,
    ClosedLoop,
    Inequality,
    LinearizedModel,
    LookAndMoveController,
    OneStep,
    PoseTarget,
    Situation,
    Squares,
    WholeTurn,
)
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.model import KinematicModel
from torch_ekm.plant import Observation, PlantWrapper
from torch_ekm.simulation import SimulatedHand

DEGREE = math.pi / 180


class KeepJoint:
    """Task: one joint keeps its angle, as far as the other tasks allow."""

    def __init__(self, joint: int, weight: float) -> None:
        self.joint, self.weight = [joint], weight

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares:
        return Squares(model.jacobian[self.joint], -model.offset[self.joint], self.weight, DEGREE)


class StaysAbove:
    """Limit: the y coordinate of the object stays above a value [m], in the hand frame."""

    def __init__(self, y: float) -> None:
        self.y = y

    def rows(self, model: LinearizedModel, seen: Situation) -> Inequality:
        row = [model.kinematic.n_q + 1]  # rows: joints, x, y, z, rotation
        room = seen.state.position[1] - self.y + model.offset[row]
        return Inequality(-model.jacobian[row], room, unit=1e-3)


class StepsWhereNear:
    """Planner: whole turns where the target is more than 3 deg away, single steps where it is nearer."""

    def plan(self, controller, seen, target, knowledge, firm):
        far = controller.focus.error(target, seen.state) > 3 * DEGREE
        return (WholeTurn() if far else OneStep()).plan(controller, seen, target, knowledge, firm)


class WithoutForces(PlantWrapper):
    """Wrapper: a hand whose fingertips measure no force."""

    def observation(self, seen: Observation) -> Observation:
        return dataclasses.replace(seen, fingertip_force=None)


plant = WithoutForces(SimulatedHand("planar_two_finger", "can", preset="nominal"))
seen = plant.reset(seed=0)
ekm = EnhancedModel.for_grasp(KinematicModel(plant.hand, plant.object), seen.state)
tasks = (*DEFAULT_TASKS, KeepJoint(joint=0, weight=0.01))
limits = (*DEFAULT_LIMITS, StaysAbove(seen.state.position[1].item() - 0.001))
controller = LookAndMoveController(ekm, plant.rotation_axis, tasks, limits)
target = PoseTarget.turned(seen.state, plant.rotation_axis, degrees=8)
result = ClosedLoop(plant, controller, planner=StepsWhereNear()).run(target)
moved = torch.rad2deg(result.stop.final.q[0] - seen.q[0])
print(f"{result.reason.value} after {len(result.steps)} motions, joint 0 moved by {moved:.1f} deg")
