"""What is needed to try a turn on the model: a controller of one's own, and a hand at the present grasp."""

from __future__ import annotations

import copy

import torch

from ..control import FocusedPose, LookAndMoveController
from ..enhanced import EnhancedModel
from ..exceptions import ParameterError
from ..kinematics import GraspState
from ..model import KinematicModel
from ..plant import Observation
from ..typing import Float, Tensor
from .model_hand import ModelHand


def own_controller(
    model: LookAndMoveController | KinematicModel | EnhancedModel, axis: Tensor | None
) -> LookAndMoveController:
    """A controller apart from the given one, with a pace of its own.

    Raises:
        ParameterError: a model without an axis.
    """
    if isinstance(model, LookAndMoveController):
        controller = copy.copy(model)
        if axis is not None:
            controller.focus = FocusedPose.rotation_about(axis)
    elif axis is None:
        raise ParameterError("axis", None, "given with a model; a controller has a focus of its own")
    else:
        controller = LookAndMoveController(model, axis)
    controller.pace = copy.deepcopy(controller.pace)
    return controller


def axis_of(focus: FocusedPose) -> Float[Tensor, " 3"]:
    """Of a focus that is the rotation about it.

    Raises:
        ParameterError: the focus is something else.
    """
    if focus.matrix.shape[0] != 1 or bool((focus.matrix[:, :3].abs() > 1e-9).any()):
        raise ParameterError("focus", focus.matrix.tolist(), "a rotation about one axis")
    return focus.matrix[0, 3:]


def hand_at(controller: LookAndMoveController, seen: Observation | GraspState) -> ModelHand:
    """Where the turn begins.

    Raises:
        GraspError: the model refuses the grasp.
    """
    model = controller.kinematic if controller.enhanced is None else controller.enhanced
    if isinstance(seen, Observation):
        state, a, force = seen.state, seen.a, seen.fingertip_force
    else:
        state, force = seen, None
        lin = controller.kinematic.linearize(seen)
        reduction = controller.kinematic.reduction
        rest = torch.as_tensor(controller.kinematic.hand.actuator_offset).to(seen.q)
        a = rest + reduction.actuation @ seen.q - lin.forces.lam / reduction.stiffness
    hand = ModelHand(model, state, a, force)
    if hand.linearization is None:
        controller.kinematic.linearize(hand.observe().state)  # says why
    return hand
