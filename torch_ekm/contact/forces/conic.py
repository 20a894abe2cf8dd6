"""The force problem with exact friction cones, as one second-order cone program."""

from __future__ import annotations

import numpy as np

from ..._extras import require
from .problem import (
    BalanceEquations,
    ForceOptions,
    ForceSolution,
    classify_failure,
    force_problem,
    unpack,
)


def solve_conic(eq: BalanceEquations, options: ForceOptions) -> ForceSolution:
    """``min 1/2 x^T P x + q^T x`` s.t. ``G mu = V_p``, bounds, ``|u_i| <= mu_s f_n,i``, by Clarabel.

    Clarabel's form is ``A x + s = b`` with ``s`` in a product of cones: zero (equalities), nonnegative
    (bounds), second order (one per contact).
    """
    clarabel, sparse = require("clarabel"), require("scipy.sparse")
    problem, scale = force_problem(eq, options, polyhedral=False)
    n, n_h = len(problem.q), eq.object_matrix.shape[1]
    blocks, rhs, cones = [], [], []
    if problem.A is not None:
        blocks.append(problem.A)
        rhs.append(problem.b)
        cones.append(clarabel.ZeroConeT(len(problem.b)))
    eye = np.eye(n)
    up, low = np.isfinite(problem.ub), np.isfinite(problem.lb)
    blocks += [eye[up], -eye[low]]
    rhs += [problem.ub[up], -problem.lb[low]]
    cones.append(clarabel.NonnegativeConeT(int(up.sum() + low.sum())))
    for cone in eq.cones:
        if not cone.dim:
            continue
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
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(problem.P)),
        problem.q,
        sparse.csc_matrix(np.concatenate(blocks)),
        np.concatenate(rhs),
        cones,
        settings,
    )
    solution = solver.solve()
    if solution.status not in (clarabel.SolverStatus.Solved, clarabel.SolverStatus.AlmostSolved):
        return classify_failure(eq, options, None, 1)
    return unpack(eq, options, scale * np.asarray(solution.x), 1)
