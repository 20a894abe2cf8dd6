"""What a grasp can reach, how far it can be turned, and what ends it, before anything moves."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from .._checks import check_kind
from .._noise import DEGREE
from ..exceptions import GraspError, ParameterError, SolverError
from ..plant import Observation
from ..typing import Float, Tensor
from .controller import LookAndMoveController
from .focus import A_TARGET, FocusedPose, PoseTarget
from .limits import ActuatorLimit
from .plan import Plan, WholeTurn
from .qp import as_array, build_qp
from .rehearsal import End
from .situation import LinearizedModel, Situation
from .tasks import EffortTask, FocusTask, OffAxisTask

if TYPE_CHECKING:
    from .knowledge import HandKnowledge

_WEAK = 0.035  # of the largest gain: a direction that motors do not hold; those that they hold have .07
_LEFT = 0.2  # of an error that the motors leave at the ends of their ranges, to decline it
# off a focus without turns, from which a target is declined [rad]: 3 mm alone turn by 8 to 10 deg
_OFF = 12 * DEGREE


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


@dataclass(frozen=True)
class Reachability:
    """``M_c D E_p J_m = U diag(gains) V^T``: what J_m says of a target; D counts 0.8 mm as 1 deg."""

    gains: Float[Tensor, " n_x"]
    """Turn of the object for a turn of the motors, the largest first: they give rank and conditioning."""
    reason: str = ""
    """Why the target is not reachable; empty: it is."""


@torch.no_grad()
def reachability(controller: LookAndMoveController, seen: Observation, target: PoseTarget) -> Reachability:
    """See :meth:`~torch_ekm.control.ClosedLoop.reachability`."""
    focus, error = controller.focus, check_kind("target", target, PoseTarget, A_TARGET).error(seen.state)
    lin = controller.kinematic.linearize(seen.state, fingertip_force=seen.fingertip_force)
    model, asked = LinearizedModel.about(torch.zeros_like(seen.a), lin), focus.matrix @ error
    whole = Situation(controller.kinematic.hand, focus, seen.state, seen.a, None, error, asked)
    limits = (limit for limit in controller.limits if isinstance(limit, ActuatorLimit))
    within = dataclasses.replace(next(limits, ActuatorLimit()), step=math.inf).rows(model, whole)
    moves = torch.from_numpy(as_array(within.lower) < as_array(within.upper))
    scaled = asked.new_tensor([[1250 * DEGREE]] * 3 + [[1.0]] * 3) * lin.object_jacobian[:, moves]
    U, found, _ = torch.linalg.svd(focus.matrix @ scaled)
    gains = torch.cat([found, found.new_zeros(len(asked) - len(found))])
    least = float(_WEAK * torch.linalg.matrix_norm(scaled, 2))
    if _is_turn(focus):  # its path says more, if the whole ranges of the motors come as far to first order
        hand, far = controller.kinematic.hand, focus.error(target, seen.state)
        way = float(np.linalg.norm((hand.actuator_upper - hand.actuator_lower)[moves.numpy()]))
        most = float(gains[-1]) * way
        if gains[-1] >= least and most >= far:
            return Reachability(gains)
        turns = (
            f"the whole ranges of the motors turn the object by some {most / DEGREE:.1f} deg about this axis"
        )
        return Reachability(gains, f"{turns}: choose a nearer target, or another axis")
    if gains[-1] < least:
        parts = sorted(zip(U[:, -1].abs().tolist(), map(str, focus.directions), strict=True), reverse=True)
        weak = " with ".join(name for share, name in parts if share > 0.3)
        held = f"{int((gains >= least).sum())} of the {len(gains)} directions of the focus"
        return Reachability(gains, f"the motors hold {held}, and too little of {weak}: leave a direction out")
    tasks = (task.rows(model, whole) for task in (EffortTask(), OffAxisTask(), FocusTask()))
    solution, reason = build_qp(len(seen.a), [*tasks, within]).solve(), ""
    left = float(np.abs(solution.slack).max()) / max(focus.error(target, seen.state), 1e-9)
    off = focus.off_rotation(lin.object_jacobian @ torch.from_numpy(solution.u))
    if left > _LEFT:
        reason = (
            f"motors at the ends of their ranges leave {100 * left:.0f} % of the way; choose a nearer target"
        )
    elif off > _OFF:
        reason = f"the object turns {off / DEGREE:.0f} deg off the focus on the way; choose a nearer target"
    return Reachability(gains, reason)


def out_of_reach(controller: LookAndMoveController, seen: Observation, target: PoseTarget) -> str:
    """Why a target is declined; empty: it is not."""
    try:
        return reachability(controller, seen, target).reason
    except (ParameterError, GraspError, SolverError):  # the loop will say so itself
        return ""


def _is_turn(focus: FocusedPose) -> bool:
    return [one.unit for one in focus.directions] == ["deg"]
