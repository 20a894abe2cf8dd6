"""What the learner of a grasp's residual is given, and which one is taken unless another is named."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from .._checks import check_kind
from .._recorded import Recorded
from ..exceptions import NoContactError, UnknownNameError
from ..kinematics.poses import A_STATE, GraspState
from ..residual import ActionLinearKernel, ForgettingFactor, RobustWeight, SparseOnlineGP, SquaredExponential
from ..typing import Float, Tensor

if TYPE_CHECKING:
    from ..model import KinematicModel

#: s2 of a motion in mm and deg: what camera, servo and play leave unexplained.
NOISE_VARIANCE = 0.1
#: Variance of an entry of G: with f as described, and with one that adapts and leaves little to g. By
#: the evidence of hands of all kinds (docs/explanation/hand_figures.md).
ACTION_VARIANCE, SMALL_ACTION_VARIANCE = 0.1, 0.003
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


def grasp_learner(n_s: int, n_a: int, capacity: int = 60, *, adapts: bool = False) -> SparseOnlineGP:
    """``g ~ GP(0, k)``, k of :func:`grasp_kernel`, outputs in mm and deg; robust, slowly forgetting.

    Args:
        n_s, n_a: features of the state (of the order of 1 cm or 0.3 rad), actuators (units of 2 deg).
        capacity: largest number of basis vectors.
        adapts: f follows figures of the hand as they are learned, so g has less to correct.
    """
    parts = [RobustWeight(3.0), ForgettingFactor(0.995)]
    kernel = grasp_kernel(n_s, n_a, SMALL_ACTION_VARIANCE if adapts else ACTION_VARIANCE)
    options = {"capacity": capacity, "kernel": kernel, "noise_variance": NOISE_VARIANCE}
    # the kernel's figures are in the units of a grasp
    return SparseOnlineGP(n_s + n_a, 6, **options, parts=parts, standardize=False)


def grasp_kernel(n_s: int, n_a: int, action_variance: float = ACTION_VARIANCE) -> ActionLinearKernel:
    """``g(s, w) = G(s) w`` of what the encoders did, w: one decision is one convex program.

    Each entry of G has a variance of ``action_variance`` in mm or deg for 2 deg of an actuator, and is smooth
    over 6 cm and 1.8 rad of the state. The servos' dead zone, which no such g can say, is the servo
    inverse's.
    """
    state = SquaredExponential(n_s, lengthscale=6.0)
    return ActionLinearKernel(n_s + n_a, n_a, state_kernel=state, action_variance=action_variance)
