"""Equilibrium of one grasp as data, and the forces that answer it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ...typing import Array
from ..contact_set import CHARACTERISTIC_LENGTH
from .friction import FrictionCone

Mask = NDArray[np.bool_]


class ForceStatus(Enum):
    """Whether the force problem was solved, is impossible, or made the solver fail."""

    SOLVED = "solved"
    NOT_GRASPABLE = "not_graspable"
    """No forces inside the cones and bounds balance the object."""
    FAILED = "failed"
    """The solver gave up; nothing is known."""


@dataclass(frozen=True)
class BalanceEquations:
    """Equilibrium at one state, reduced to the permitted motions (rigid couplings taken out).

    ```
    object_matrix mu = object_load                         G mu = V_p
    hand_matrix mu + actuator_matrix lam + bound_matrix tau - r = -hand_load
    ```
    """

    object_matrix: Array
    """G, contact forces to the wrench on the object, ``(n_w, n_h)``."""
    object_load: Array
    """V_p, gradient of the potential energy by the object's pose [N, N m], ``(n_w,)``."""
    hand_matrix: Array
    """(J_h Z)^T, ``(n_z, n_h)``."""
    actuator_matrix: Array
    """(J_a Z)^T, ``(n_z, n_a)``."""
    hand_load: Array
    """Z^T V_q, torques of the springs in the permitted motions [N m], ``(n_z,)``."""
    cones: tuple[FrictionCone, ...]
    moment_rows: Mask
    """Rows of ``object_load`` that are moments, bool ``(n_w,)``."""
    tendon: Mask
    """Actuators that only pull, bool ``(n_a,)``."""
    spin_columns: tuple[int, ...] = ()
    """Components of ``mu`` that are moments."""
    bound_matrix: Array = field(default_factory=lambda: np.zeros((0, 0)))
    """Z^T of unit joint torques with bounds of their own (stops), ``(n_z, n_t)``."""
    bound_lower: Array = field(default_factory=lambda: np.zeros(0))
    bound_upper: Array = field(default_factory=lambda: np.zeros(0))
    measured_normal: Array | None = None
    """Measured normal forces [N], NaN where there is none."""
    expected: Array | None = None
    """Forces ``mu`` to stay near, ``(n_h,)``."""
    expected_covariance: Array | None = None
    """Of ``expected``, ``(n_h, n_h)``."""

    @property
    def row_scale(self) -> Array:
        """1 for forces on the object, 1/L for moments, ``(n_w,)``."""
        return np.where(self.moment_rows, 1 / CHARACTERISTIC_LENGTH, 1.0)


@dataclass(frozen=True)
class ForceSolution:
    """Forces in the order of the problem's unknowns; NaN unless solved."""

    status: ForceStatus
    mu: Array
    """[N], moment rows [N m]."""
    lam: Array
    """Minus the actuator forces along +a [N or N m]."""
    bound: Array
    """Torques of stops [N m]."""
    residual: Array
    """r: unexplained generalised torque, ``(n_z,)`` [N m]. Large: wrong spring or rest angle, slipping."""
    violation: float
    """Smallest norm of the unbalanced object wrench (moments divided by L) [N]; about 0 when solved."""
    solves: int
    """Number of QPs; 0: the answer without inequalities keeps them all."""
    covariance: Array | None = None
    """Of ``mu`` about the answer, ``(n_h, n_h)``; None without ``expected_covariance``."""
