"""Other ways to the answers of the force problem, for comparison."""

from __future__ import annotations

import clarabel
import numpy as np
from scipy import sparse

from torch_ekm.contact.forces.balance import BalanceEquations
from torch_ekm.contact.forces.options import ForceOptions
from torch_ekm.contact.forces.problem import force_problem


def cone_program(eq: BalanceEquations, options: ForceOptions | None = None) -> np.ndarray | None:
    """``[mu; lam; tau]`` with exact second-order cones in place of polyhedra and cuts; None: infeasible."""
    n_h = eq.object_matrix.shape[1]
    problem, scale = force_problem(eq, options or ForceOptions(), np.zeros((0, n_h)))
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
