"""The learner of a grasp's residual that is taken unless another is named."""

from __future__ import annotations

import torch

from ..residual import ForgettingFactor, RobustWeight, SparseOnlineGP, SquaredExponential

#: s2 of a motion in mm and deg: what camera, servo and play leave unexplained.
NOISE_VARIANCE = 0.1


def grasp_learner(n_s: int, n_a: int, capacity: int = 60) -> SparseOnlineGP:
    """``g ~ GP(0, k)``, k of :func:`grasp_kernel`, six outputs [mm, deg]; robust, slowly forgetting.

    Args:
        n_s, n_a: features of the state (of the order of 1 cm or 0.3 rad), actuators (units of 2 deg).
        capacity: largest number of basis points.
    """
    parts = [RobustWeight(3.0), ForgettingFactor(0.995)]
    kernel = grasp_kernel(n_s, n_a)
    options = {"capacity": capacity, "kernel": kernel, "noise_variance": NOISE_VARIANCE}
    return SparseOnlineGP(n_s + n_a, 6, **options, parts=parts)


def grasp_kernel(n_s: int, n_a: int) -> SquaredExponential:
    """Squared exponential, smooth over 15 mm and 15 deg of the state and 8 deg of an actuator.

    It takes up the dead zone, which no kernel that is linear in the action can.
    """
    lengthscale = torch.tensor([15.0] * n_s + [4.0] * n_a, dtype=torch.float64)
    return SquaredExponential(n_s + n_a, lengthscale=lengthscale, variance=4.0)
