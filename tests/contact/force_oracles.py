"""Other ways to the answers of the force problem, for comparison."""

from __future__ import annotations

import clarabel
import numpy as np
from scipy import sparse

from torch_ekm.contact.forces import BalanceEquations, ForceOptions, force_cost, force_problem


def cone_program(eq: BalanceEquations, options: ForceOptions | None = None) -> np.ndarray | None:
    """``[mu; lam; tau]`` with exact second-order cones in place of polyhedra and cuts; None: infeasible."""
    n_h = eq.object_matrix.shape[1]
    options = options or ForceOptions()
    cost = force_cost(eq, options)
    problem, scale = force_problem(eq, cost), cost.scale
    n = len(problem.q)
    up, low = np.isfinite(problem.ub), np.isfinite(problem.lb)
    eye = np.eye(n)
    blocks, rhs = [problem.A, eye[up], -eye[low]], [problem.b, problem.ub[up], -problem.lb[low]]
    cones = [clarabel.ZeroConeT(len(problem.b)), clarabel.NonnegativeConeT(int(up.sum() + low.sum()))]
    for cone in eq.cones:
        rows = np.zeros((1 + cone.dim, n))
        rows[0, cone.start] = -cone.mu_s
        rows[1:, cone.start + 1 : cone.start + 1 + cone.dim] = -np.diag(cone.scale)
        rows[:, :n_h] *= scale[:n_h]
        blocks.append(rows)
        rhs.append(np.zeros(1 + cone.dim))
        cones.append(clarabel.SecondOrderConeT(1 + cone.dim))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    P, A = sparse.csc_matrix(np.triu(problem.P)), sparse.csc_matrix(np.concatenate(blocks))
    solution = clarabel.DefaultSolver(P, problem.q, A, np.concatenate(rhs), cones, settings).solve()
    found = solution.status in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved)
    return scale * np.asarray(solution.x) if found else None


def gaussian_posterior(eq: BalanceEquations, options: ForceOptions) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of ``[mu; lam]`` by Kalman's gain; balance, joints and sensors are measurements."""
    n_h, n_a = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1]
    S = np.zeros((n_h + n_a, n_h + n_a))
    S[:n_h, :n_h], S[n_h:, n_h:] = eq.expected_covariance, 1e4 * np.eye(n_a)
    x = np.concatenate([eq.expected, np.zeros(n_a)])
    eye = np.eye(n_h + n_a)
    measured = [  # rows, value, variance
        (np.hstack([eq.hand_matrix, eq.actuator_matrix]), -eq.hand_load, options.torque_std**2),
        (np.hstack([eq.object_matrix, np.zeros((len(eq.object_load), n_a))]), eq.object_load, 0.0),
    ]
    if eq.measured_normal is not None:
        starts = [cone.start for cone in eq.cones]
        known = np.isfinite(eq.measured_normal)
        measured.append((eye[starts][known], eq.measured_normal[known], options.normal_std**2))
    for H, value, variance in measured:
        gain = S @ H.T @ np.linalg.inv(H @ S @ H.T + variance * np.eye(len(H)))
        x, S = x + gain @ (value - H @ x), S - gain @ H @ S
    return x, S
