"""The learner of a grasp's residual that is taken unless another is named."""

from __future__ import annotations

from typing import Any

import torch

from ..residual import SparseOnlineGP, SquaredExponential

#: s2 of a motion in mm and deg: what camera, servo and play leave unexplained.
NOISE_VARIANCE = 0.1


def grasp_learner(n_s: int, n_a: int, capacity: int = 60, **options: Any) -> SparseOnlineGP:
    """``g ~ GP(0, k)``, k squared exponential over state and action, six outputs.

    Smooth over 15 mm, 15 deg of the state and 8 deg of an actuator, it takes up the dead zone, which no
    kernel that is linear in the action can.

    Args:
        n_s, n_a: features of the state (of the order of 1 cm or 0.3 rad), actuators (units of 2 deg).
        capacity: largest number of basis points.
        options: of the SparseOnlineGP.
    """
    lengthscale = torch.tensor([15.0] * n_s + [4.0] * n_a, dtype=torch.float64)
    kernel = SquaredExponential(n_s + n_a, lengthscale=lengthscale, variance=4.0)
    chosen = {"noise_variance": NOISE_VARIANCE, "robust": 3.0, "forgetting": 0.995, **options}
    return SparseOnlineGP(n_s + n_a, 6, capacity=capacity, kernel=kernel, **chosen)
