"""What a grasp can reach, how far it can be turned, and what ends it, before anything moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from .._noise import DEGREE
from ..exceptions import GraspError, ParameterError
from ..plant import Observation
from .controller import LookAndMoveController
from .focus import FocusedPose, PoseTarget
from .limits import ActuatorLimit
from .plan import Plan, WholeTurn
from .rehearsal import End

if TYPE_CHECKING:
    from .knowledge import HandKnowledge

_WEAK = 0.035  # of the largest gain: a direction that motors do not hold; those that they hold have .07


@dataclass(frozen=True)
class Reach:
    """How far an object can be turned about an axis, by the model."""

    angle: float
    """Largest on the way, with the sign that was asked about [rad]."""
    end: End
    """What ends it."""
    safe: float
    """To the last waypoint that is safe, see :class:`WholeTurn` [rad]."""
    plan: Plan
    """The path."""

    def __str__(self) -> str:
        return f"{self.angle / DEGREE:.1f} deg ({self.end})"


@torch.no_grad()
def reach(
    controller: LookAndMoveController, knowledge: HandKnowledge, seen: Observation, sign: int, limit: float
) -> Reach:
    """See :meth:`~torch_ekm.control.ClosedLoop.reach`."""
    if sign not in (1, -1):
        raise ParameterError("sign", sign, "1 or -1")
    if not 0 < limit <= 170 * DEGREE:
        raise ParameterError("limit", limit, "above 0 and at most 170 deg [rad]")
    if not _is_turn(controller.focus):
        raise ParameterError("focus", controller.focus.matrix.tolist(), "a rotation about one axis")
    axis = controller.focus.matrix[0, 3:]
    controller.kinematic.linearize(seen.state)  # raises, and says why
    target = PoseTarget.turned(seen.state, axis, sign * limit)
    plan = WholeTurn().plan(controller, seen, target, knowledge, 0.0, whole=True, longest=math.inf)
    turned = [float(axis @ state.minus(seen.state)[-3:]) for state in plan.states]
    return Reach(turned[-1], plan.end, turned[plan.safe], plan)


@torch.no_grad()
def out_of_reach(controller: LookAndMoveController, seen: Observation, target: PoseTarget) -> str:
    """Why motors cannot bring an object to a target; empty: they can, as far as J_m says.

    Two tests, of first order: the motors hold each direction of the focus, by the singular values of
    ``M_c D E_p J_m`` with D that counts 0.8 mm as 1 deg; and their whole ranges come as far as the target.
    """
    focus, hand = controller.focus, controller.kinematic.hand
    try:
        lin = controller.kinematic.linearize(seen.state, fingertip_force=seen.fingertip_force)
    except GraspError:  # the loop will say so itself
        return ""
    D = torch.tensor([1250 * DEGREE] * 3 + [1.0] * 3, dtype=torch.float64)
    asked = focus.matrix @ (D * target.error(seen.state))
    limits = (limit for limit in controller.limits if isinstance(limit, ActuatorLimit))
    moves = next(limits, ActuatorLimit()).moves(hand)
    scaled = (D[:, None] * lin.object_jacobian)[:, torch.from_numpy(moves)]
    U, found, _ = torch.linalg.svd(focus.matrix @ scaled)
    gains = torch.cat([found, found.new_zeros(len(asked) - len(found))])
    held = gains >= _WEAK * torch.linalg.matrix_norm(scaled, 2)
    if not (_is_turn(focus) or bool(held.all())):
        parts = sorted(zip(U[:, -1].abs().tolist(), map(str, focus.directions), strict=True), reverse=True)
        weak = " with ".join(name for share, name in parts if share > 0.3)
        few = f"the motors hold {int(held.sum())} of the {len(gains)} directions of the focus"
        return f"{few}, and too little of {weak}: leave a direction out"
    room = torch.from_numpy((hand.actuator_upper - hand.actuator_lower)[np.flatnonzero(moves)])
    share = float((asked @ focus.matrix @ scaled).abs() @ room / (asked @ asked).clamp(min=1e-9))
    if bool(held.all()) and share >= 1:  # the path of a turn about one axis says more
        return ""
    most = f"to first order the whole ranges of the motors come {100 * min(share, 1):.0f} % of the way"
    return f"{most}: choose a nearer target, or another direction"


def _is_turn(focus: FocusedPose) -> bool:
    return [one.unit for one in focus.directions] == ["deg"]
