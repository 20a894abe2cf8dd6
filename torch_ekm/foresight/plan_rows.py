"""What tasks and limits ask of each motion of a path."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..control import Bounds, Inequality, Limit, LimitingFunction, LinearizedModel, Situation, Task
from ..control.qp import DEGREE, as_array, sum_rows
from ..kinematics.se3 import exp, log
from ..typing import Float, Int, Tensor
from .path import Path, Rates
from .plan_problem import MotionRows

if TYPE_CHECKING:
    from ..enhanced import EnhancedModel
    from ..kinematics import GraspState

_PACE = 1e4
"""Penalty of a motion that is longer than the pace allows, per degree: above that of the goal."""
_EVEN, _WAIT = 0.95, 10.0
"""Least share of the mean motion, and the penalty of less, per degree: a plan that puts off its motions, made
again before each of them, would not come to an end."""


def error_of(state: GraspState, seen: Situation) -> Float[Tensor, "*batch 6"]:
    """The twist from states to the target of a situation [m, rad]."""
    position, rotation = seen.state.position + seen.error[:3], exp(seen.error[3:]) @ seen.state.rotation
    return torch.cat([position - state.position, log(rotation @ state.rotation.mT)], dim=-1)


def situation(
    seen: Situation,
    state: GraspState,
    moved: Float[Tensor, " n_a"],
    error: Float[Tensor, 6],
    desired: Float[Tensor, " n_x"],
    pads: Int[Tensor, " n_c"],
    more: Float[Tensor, " n_c"],
) -> Situation:
    """What will be seen at a state on the way.

    Args:
        moved: by the actuators until then [rad].
        pads: of the contacts.
        more: what their normal forces will have changed until then [N].
    """
    felt, alone = seen.fingertip_force, seen.joint_force
    return dataclasses.replace(
        seen,
        state=state,
        a=seen.a + moved,
        error=error,
        desired=desired,
        fingertip_force=None if felt is None else felt.index_add(0, pads, more),
        joint_force=None if alone is None else alone + more,
    )


@dataclass(frozen=True)
class PlanRows:
    """Rows of tasks and limits about a path, motion by motion.

    A task sees motion k as it would see a single step from z_k: ``(f + g)(s_k, u) ~ offset + jacobian u``,
    with the forces that are foreseen there. Its rows then count in ``u = c_k - before_k``, for where the
    earlier motions leave the actuators decides where motion k begins (see :func:`plan_problem`); bounds, and
    rows of tasks that are ``per_motion``, count in w_k.

    ``dz_{k+1}/dw_j = (dz/da)(z_{k+1})`` for every j <= k: what the actuators do first and what later makes no
    difference where contacts do not roll about their normals, as in a plane. In space it makes one of second
    order, so the path is exact, but not quite the best.
    """

    tasks: Sequence[Task]
    limits: Sequence[Limit]
    limiting: LimitingFunction
    pace: float
    enhanced: EnhancedModel | None

    def about(
        self, seen: Situation, path: Path, rates: Rates, left: Float[Tensor, " n_x"]
    ) -> list[MotionRows]:
        """Rows of all motions.

        Args:
            seen: where the path begins; its ``desired`` bounds the first motion.
            left: what of the focused error may be left at the end.
        """
        M, n_a = seen.focus.matrix, path.actions.shape[-1]
        s, normal = path.nodes.state, path.nodes.forces.normal
        errors = error_of(s, seen)
        J = rates.jacobian[1:]
        offsets = path.increments - (J @ path.actions[..., None])[..., 0]
        before = torch.cat([path.actions.new_zeros(1, n_a), path.actions.cumsum(0)])
        pads = torch.tensor(seen.hand.pad_indices(path.nodes.contacts.finger))
        focused = M @ seen.error
        ahead = (focused / torch.linalg.vector_norm(focused).clamp_min(1e-12)) @ M
        least = _EVEN * float(torch.linalg.vector_norm(focused - left)) / len(path.actions)
        longest = self._longest(seen, path)
        motions = []
        for k in range(len(path.actions)):
            here = rates.at(k)
            desired = M @ errors[k] - left
            now = situation(seen, here.state, before[k], errors[k], desired, pads, normal[k] - normal[0])
            w, S = path.actions[k], as_array(rates.linearization.normal_force_sensitivity[k + 1])
            model = LinearizedModel(
                here,
                w,
                offsets[k],
                J[k],
                as_array(normal[k + 1] - normal[k]) - S @ as_array(w),
                S,
                None if self.enhanced is None else partial(self.enhanced.variance, here.state, w),
            )
            parts = (*self.tasks, *self.limits)
            asked = [(part.rows(model, now), getattr(part, "per_motion", False)) for part in parts]
            single = [rows for rows, alone in asked if alone or isinstance(rows, Bounds)]
            others = [rows for rows, alone in asked if not (alone or isinstance(rows, Bounds))]
            pace = self._pace(ahead, model, longest[k], min(least, longest[k]))
            ends = (as_array(before[at]) / DEGREE for at in (k, k + 1))
            motions.append(MotionRows(sum_rows(n_a, others), sum_rows(n_a, [*single, *pace]), *ends))
        return motions

    def _longest(self, seen: Situation, path: Path) -> list[float]:
        """The largest motions of the focused pose that the limiting function allows [unit of the focus]."""
        M, focused = seen.focus.matrix, seen.focus.matrix @ seen.error
        v, w = (M.mT @ focused).split(3)
        lever = path.nodes.contacts.point - path.nodes.state.position[:, None, :]
        carried = torch.linalg.vector_norm(v + torch.linalg.cross(w.expand_as(lever), lever), dim=-1).amax(-1)
        size = float(torch.linalg.vector_norm(focused))
        steps = (self.limiting.steps(focused, travel) for travel in carried[:-1].tolist())
        longest = [size * self.pace / max(count, 1e-12) for count in steps]
        longest[0] = float(torch.linalg.vector_norm(seen.desired))
        return longest

    def _pace(
        self, ahead: Float[Tensor, 6], model: LinearizedModel, longest: float, least: float
    ) -> list[Inequality]:
        """``least <= ahead . ds <= longest``."""
        row, c = as_array(ahead @ model.jacobian[-6:])[None], float(ahead @ model.offset[-6:])
        return [
            Inequality(row, np.array([longest - c]), DEGREE, _PACE),
            Inequality(-row, np.array([c - least]), DEGREE, _WAIT),
        ]
