"""What tests of the loop do with a plant that obeys a kinematic model."""

import contextlib
import dataclasses
from collections.abc import Callable

import torch
from light_plant import Fault as Fault
from light_plant import Obedient as Obedient

from torch_ekm.control import ClosedLoop, LookAndMoveController, Manipulation, PoseTarget, Step
from torch_ekm.enhanced import EnhancedModel
from torch_ekm.kinematics.se3 import exp
from torch_ekm.plant import Observation


def one_more(field: str, place: int, size: float) -> Fault:
    """One entry of a reading is off by so much."""

    def change(plant: Obedient, seen: Observation) -> Observation:
        value = getattr(seen, field).clone()
        value[place] += size
        return dataclasses.replace(seen, **{field: value})

    return change


def untaught(held: tuple, *fault: Fault, since: int = 2, **options: object) -> ClosedLoop:
    """An E-KM that has learned nothing turns about the held axis; its plant obeys the kinematic model."""
    seen, axis, model = held
    controller = LookAndMoveController(EnhancedModel.for_grasp(model, seen.state), axis)
    return ClosedLoop(Obedient(model, seen, *fault, since=since), controller, **options)


def turned(seen: Observation, axis: torch.Tensor, angle: float) -> Observation:
    """``seen`` with its object turned further by ``angle`` [rad]."""
    return dataclasses.replace(seen, rotation=exp(angle * axis) @ seen.rotation)


def watched(loop: ClosedLoop, target: PoseTarget, on_step: Callable[[Step], object]) -> Manipulation:
    """As ``loop.run(target)``, with a look at each motion when it is over."""
    steps = []
    with contextlib.closing(loop.steps(target)) as motions:
        while True:
            try:
                steps.append(next(motions))
            except StopIteration as end:
                return Manipulation(target, loop.controller.focus, tuple(steps), end.value)
            on_step(steps[-1])
