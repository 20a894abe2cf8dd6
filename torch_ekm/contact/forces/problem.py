"""The relaxed minimal-force problem as a quadratic program."""

from __future__ import annotations

import numpy as np

from ..._extras import require
from ...typing import Array
from .balance import BalanceEquations
from .friction import outer_directions
from .options import ForceOptions


def force_problem(eq: BalanceEquations, options: ForceOptions, cuts: Array, *, soft: bool = False):
    """Build the QP in ``x = [mu; lam; tau]``, all scaled to newtons.

    ```
    min  eps (|mu|^2 + k |lam r/L|^2) + |r|^2 / sigma^2 + sum (f_n - measured)^2 / sigma_n^2
    s.t. G mu = V_p,  f_min <= f_n <= f_max,  |u_i| <= mu_s f_n,i,  -lam >= 0 for tendons,  bounds
    ```

    The friction cones stand in it as polyhedra around them; ``cuts`` carve those down to the cones.

    Args:
        eq: the balance.
        options: weights and bounds.
        cuts: more rows ``g mu <= 0``, ``(k, n_h)``.
        soft: put the object balance into the cost, to measure how far it is from possible.

    Returns:
        ``qpsolvers.Problem`` and the scale of the unknowns, ``unknowns = scale * x``.
    """
    qpsolvers = require("qpsolvers")
    L = eq.length
    n_h, n_a, n_t = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1], len(eq.bound_lower)
    n = n_h + n_a + n_t
    scale = np.ones(n)
    scale[list(eq.spin_columns)] = L
    scale[n_h:] = L
    # typical moment arm: 1 for motors in rad, a radius for cables in m
    arm = np.linalg.norm(eq.actuator_matrix, axis=0)
    scale[n_h : n_h + n_a] /= np.where(arm > 0, arm, 1.0)
    balance = np.zeros((len(eq.object_load), n))
    balance[:, :n_h] = eq.object_matrix * eq.row_scale[:, None] * scale[:n_h]
    load = eq.object_load * eq.row_scale
    bound = eq.bound_matrix.reshape(len(eq.hand_load), n_t)
    joint = np.concatenate([eq.hand_matrix, eq.actuator_matrix, bound], axis=1) * scale

    P = np.diag(np.concatenate([np.ones(n_h), np.full(n_a, options.actuator_weight), np.full(n_t, 1e-2)]))
    P *= options.force_weight
    W = 1 / options.torque_std**2 if eq.weight is None else eq.weight / options.torque_std**2
    WJ = W * joint if eq.weight is None else W @ joint
    P += joint.T @ WJ
    q = WJ.T @ eq.hand_load
    if soft:
        P = P * 1e-9 + balance.T @ balance
        q = q * 1e-9 - balance.T @ load
    normals = [cone.start for cone in eq.cones]
    if eq.measured_normal is not None:
        known = np.isfinite(eq.measured_normal)
        for i, column in enumerate(normals):
            if known[i]:
                P[column, column] += 1 / eq.normal_std**2
                q[column] -= eq.measured_normal[i] / eq.normal_std**2

    rows = np.concatenate([*(cone.rows(outer_directions(cone.dim), n_h) for cone in eq.cones), cuts])
    inequality = np.zeros((len(rows), n))
    inequality[:, :n_h] = rows * scale[:n_h]
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    lower[normals], upper[normals] = options.min_normal, options.max_normal
    upper[n_h : n_h + n_a] = np.where(eq.tendon, 0.0, np.inf)
    if n_t:
        lower[n_h + n_a :], upper[n_h + n_a :] = eq.bound_lower / L, eq.bound_upper / L
    hard, rhs = (None, None) if soft else (balance, load)
    return qpsolvers.Problem(P, q, inequality, np.zeros(len(rows)), hard, rhs, lower, upper), scale
