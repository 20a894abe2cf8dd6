"""From the state of a grasp to the inputs of a learner."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from .._checks import check_kind
from .._recorded import Recorded
from ..exceptions import NoContactError, UnknownNameError
from ..kinematics.grasp_state import A_STATE, GraspState
from ..typing import Float, Tensor

if TYPE_CHECKING:
    from ..model import KinematicModel

_Q_SCALE = 0.3  # [rad]
_POSITION_SCALE = 0.01  # [m]
_ROTATION_SCALE = 0.3  # [rad]


class GraspEncoding(Recorded):
    """``x_s = [(q_sel - q_ref) / q_scale; (o - o_ref) / o_scale; Log(R R_ref^T) / r_scale]``.

    Scaled by 0.3 rad, 0.01 m and 0.3 rad, so that the workspace of a pinch is of the order of 1 in each
    input.

    Args:
        reference: the state at the origin of the coordinates (e.g. the first grasp).
        joints: indices of the joints to use (those of the grasping fingers); none if empty.
    """

    def __init__(self, reference: GraspState, joints: list[int]) -> None:
        n_q = reference.q.shape[-1]
        for joint in joints:
            if not 0 <= joint < n_q:
                raise UnknownNameError("joint index", str(joint), [f"0..{n_q - 1}"])
        self.reference, self.joints = reference, joints

    @classmethod
    def of(cls, model: KinematicModel, state: GraspState) -> GraspEncoding:
        """About ``state``, with the joints that can move a finger which touches the object.

        An object or pads described wrongly may leave no pad within the margin: then those up to 6 mm off.

        Raises:
            NoContactError: nothing is as near.
        """
        hand = model.hand
        moved = torch.zeros(hand.n_q, dtype=torch.bool)
        try:
            contacts = model.contacts(state)
        except NoContactError:
            contacts = model.contacts(state, torch.full((len(hand.pads),), torch.inf))
        for link in contacts.link:
            moved |= model.kinematics.upstream[model.link_names.index(link)]  # type: ignore[index]
        free = torch.from_numpy(hand.joint_upper > hand.joint_lower)
        return cls(state, torch.nonzero(moved & free).flatten().tolist())

    @property
    def n_features(self) -> int:
        return len(self.joints) + 6

    def __call__(self, state: GraspState) -> Float[Tensor, "*batch n_features"]:
        check_kind("state", state, GraspState, A_STATE)
        dq, do, dphi = state.minus(self.reference).split([state.q.shape[-1], 3, 3], dim=-1)
        parts = dq[..., self.joints] / _Q_SCALE, do / _POSITION_SCALE, dphi / _ROTATION_SCALE
        return torch.cat(parts, dim=-1)
