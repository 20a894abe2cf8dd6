"""The relaxed force problem as a quadratic program."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..._extras import require
from ...typing import Array
from ..contact_set import CHARACTERISTIC_LENGTH
from .balance import BalanceEquations
from .friction import outer_directions
from .options import ForceOptions

MAX_NORMAL = 1e3
"""Upper bound of every normal force [N]; the lower one is 0."""
_FORCE_WEIGHT = 1e-7
"""``eps``: weight of ``|mu|^2`` against the squared, whitened joint residual [1/N^2]."""


class ForceCost(NamedTuple):
    """``1/2 x^T P x + q^T x`` subject to ``balance x = load``, with ``[mu; lam; tau] = scale * x``."""

    P: Array
    q: Array
    balance: Array
    load: Array
    scale: Array

    def covariance(self, n_h: int) -> Array:
        """``N (N^T P N)^-1 N^T`` of ``mu``, N the null space of the balance: P read as information."""
        _, sigma, Vh = np.linalg.svd(self.balance)
        N = Vh[int((sigma > 1e-9 * sigma[0]).sum()) :].T
        half = (self.scale[:, None] * N)[:n_h]
        return half @ np.linalg.solve(N.T @ self.P @ N, half.T)


def force_cost(eq: BalanceEquations, options: ForceOptions) -> ForceCost:
    """What the forces should be, in ``x = [mu; lam; tau]``, all scaled to newtons.

    ```
    min  p(mu) + eps (|arm lam/L|^2 + |tau/L|^2/100) + |r|^2/sigma^2
         + sum (f_n - measured)^2/sigma_n^2
    s.t. G mu = V_p
    p(mu) = eps |mu|^2, or (mu - expected)^T Sigma^-1 (mu - expected) where forces are expected
    ```

    With expected forces it is the negative logarithm of a posterior density (times two).
    """
    L = CHARACTERISTIC_LENGTH
    n_h, n_a, n_t = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1], len(eq.bound_lower)
    n = n_h + n_a + n_t
    scale = np.ones(n)
    scale[list(eq.spin_columns)] = L
    scale[n_h:] = L
    # typical moment arm: 1 for motors in rad, a radius for cables in m
    arm = np.sqrt((eq.actuator_matrix * eq.actuator_matrix).sum(0))
    scale[n_h : n_h + n_a] /= np.where(arm > 0, arm, 1.0)
    balance = np.zeros((len(eq.object_load), n))
    balance[:, :n_h] = eq.object_matrix * eq.row_scale[:, None] * scale[:n_h]
    bound = eq.bound_matrix.reshape(len(eq.hand_load), n_t)
    joint = np.concatenate([eq.hand_matrix, eq.actuator_matrix, bound], axis=1) * scale
    WJ = joint / options.torque_std**2
    P, q = joint.T @ WJ, WJ.T @ eq.hand_load
    diagonal = np.full(n, _FORCE_WEIGHT)
    diagonal[n_h + n_a :] *= 1e-2
    if eq.expected is not None and eq.expected_covariance is not None:
        diagonal[:n_h] = 0.0
        W = np.linalg.inv(eq.expected_covariance) * scale[:n_h, None] * scale[:n_h]  # Sigma^-1 in x
        P[:n_h, :n_h] += W
        q[:n_h] -= W @ (eq.expected / scale[:n_h])
    if eq.measured_normal is not None:
        known = np.isfinite(eq.measured_normal)
        at = np.array([cone.start for cone in eq.cones])[known]
        diagonal[at] += (scale[at] / options.normal_std) ** 2
        q[at] -= scale[at] * eq.measured_normal[known] / options.normal_std**2
    P[np.diag_indices(n)] += diagonal
    return ForceCost(P, q, balance, eq.object_load * eq.row_scale, scale)


def force_problem(eq: BalanceEquations, cost: ForceCost, cuts: Array, *, soft: bool = False):
    """Add the inequalities to the cost: a ``qpsolvers.Problem``.

    ```
    0 <= f_n <= f_max,  |u_i| <= mu_s f_n,i,  -lam >= 0 for tendons,  bounds of stops
    ```

    The friction cones stand in it as polyhedra around them; ``cuts`` carve those down to the cones.

    Args:
        eq: the balance.
        cost: of :func:`force_cost`.
        cuts: more rows ``g mu <= 0``, ``(k, n_h)``.
        soft: put the object balance into the cost, to measure how far it is from possible.
    """
    qpsolvers = require("qpsolvers")
    P, q, balance, load, scale = cost
    n_h, n_a, n = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1], len(q)
    if soft:
        P = P * 1e-9 + balance.T @ balance
        q = q * 1e-9 - balance.T @ load
    normals = [cone.start for cone in eq.cones]
    rows = np.concatenate([*(cone.rows(outer_directions(cone.dim), n_h) for cone in eq.cones), cuts])
    inequality = np.zeros((len(rows), n))
    inequality[:, :n_h] = rows * scale[:n_h]
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    lower[normals], upper[normals] = 0.0, MAX_NORMAL
    upper[n_h : n_h + n_a] = np.where(eq.tendon, 0.0, np.inf)
    L = CHARACTERISTIC_LENGTH
    lower[n_h + n_a :], upper[n_h + n_a :] = eq.bound_lower / L, eq.bound_upper / L
    hard, rhs = (None, None) if soft else (balance, load)
    return qpsolvers.Problem(P, q, inequality, np.zeros(len(rows)), hard, rhs, lower, upper)
