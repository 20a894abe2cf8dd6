"""The learner of a grasp's residual that is taken unless another is named."""

from __future__ import annotations

from ..residual import ActionLinearKernel, ForgettingFactor, RobustWeight, SparseOnlineGP, SquaredExponential

#: s2 of a motion in mm and deg: what camera, servo and play leave unexplained.
NOISE_VARIANCE = 0.1
#: Variance of an entry of G: with f as described, and with one that adapts and leaves little to g. By
#: the evidence of hands of all kinds (docs/explanation/hand_figures.md).
ACTION_VARIANCE, SMALL_ACTION_VARIANCE = 0.1, 0.003


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
