"""Contact and actuator forces of a grasp at a measured state: the relaxed minimal-force problem."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..._extras import require
from .balance import BalanceEquations as BalanceEquations
from .balance import ForceSolution as ForceSolution
from .balance import ForceStatus as ForceStatus
from .friction import FrictionCone, cutting_planes, directions
from .options import ForceOptions as ForceOptions

Array = NDArray[np.float64]


def force_problem(
    eq: BalanceEquations,
    options: ForceOptions,
    extra: Array | None = None,
    *,
    soft: bool = False,
    polyhedral: bool = True,
):
    """Build the QP in ``x = [mu; lam; tau]``, all scaled to newtons.

    ```
    min  eps (|mu|^2 + k |lam r/L|^2) + |r|^2 / sigma^2 + sum (f_n - measured)^2 / sigma_n^2
    s.t. G mu = V_p,  f_n >= f_min,  friction,  -lam >= 0 for tendons,  bounds
    ```

    Args:
        eq: the balance.
        options: weights and forms.
        extra: more rows ``g mu <= 0`` (cutting planes).
        soft: put the object balance into the cost, to measure how far it is from possible.
        polyhedral: False leaves the friction cones out.

    Returns:
        ``qpsolvers.Problem`` and the scale of the unknowns, ``unknowns = scale * x``.
    """
    qpsolvers = require("qpsolvers")
    L = options.length
    n_h, n_a, n_t = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1], len(eq.bound_lower)
    n = n_h + n_a + n_t
    scale = np.ones(n)
    scale[list(eq.spin_columns)] = L
    scale[n_h:] = L
    arm = np.linalg.norm(
        eq.actuator_matrix, axis=0
    )  # typical moment arm: 1 for motors in rad, a radius for cables in m
    scale[n_h : n_h + n_a] /= np.where(arm > 0, arm, 1.0)
    row_scale = np.where(eq.moment_rows, 1 / L, 1.0)
    balance = np.zeros((len(eq.object_load), n))
    balance[:, :n_h] = eq.object_matrix * row_scale[:, None] * scale[:n_h]
    load = eq.object_load * row_scale
    joint = np.empty((len(eq.hand_load), n))
    joint[:, :n_h] = eq.hand_matrix
    joint[:, n_h : n_h + n_a] = eq.actuator_matrix
    if n_t:
        joint[:, n_h + n_a :] = eq.bound_matrix
    joint *= scale

    P = np.diag(np.concatenate([np.ones(n_h), np.full(n_a, options.actuator_weight), np.full(n_t, 1e-2)]))
    P *= options.force_weight
    q = np.zeros(n)
    hard, rhs = balance, load
    if options.balance == "relaxed":
        W = 1 / options.torque_std**2 if eq.weight is None else eq.weight / options.torque_std**2
        WJ = W * joint if eq.weight is None else W @ joint
        P += joint.T @ WJ
        q += WJ.T @ eq.hand_load
    else:
        hard, rhs = np.concatenate([balance, joint]), np.concatenate([load, -eq.hand_load])
    if soft:
        P = P * 1e-9 + hard.T @ hard
        q = q * 1e-9 - hard.T @ rhs
        hard, rhs = None, None
    normals = [cone.start for cone in eq.cones]
    if eq.measured_normal is not None:
        known = np.isfinite(eq.measured_normal)
        for i, column in enumerate(normals):
            if known[i]:
                P[column, column] += 1 / eq.normal_std**2
                q[column] -= eq.measured_normal[i] / eq.normal_std**2

    rows = []
    for cone in eq.cones if polyhedral else ():
        d, cosine = directions(cone.dim, options.faces if "pyramid" in options.friction else 8)
        if cone.dim:
            rows.append(
                cone.rows(d, n_h, cosine if options.friction == "pyramid_inner" and cone.dim > 1 else 1.0)
            )
    if extra is not None:
        rows.append(extra)
    inequality = np.zeros((sum(len(r) for r in rows), n))
    if rows:
        inequality[:, :n_h] = np.concatenate(rows) * scale[:n_h]
    lower, upper = np.full(n, -np.inf), np.full(n, np.inf)
    lower[normals], upper[normals] = options.min_normal, options.max_force
    lower[n_h : n_h + n_a] = -options.max_actuator / scale[n_h : n_h + n_a]
    upper[n_h : n_h + n_a] = np.where(eq.tendon, 0.0, options.max_actuator / scale[n_h : n_h + n_a])
    if n_t:
        lower[n_h + n_a :], upper[n_h + n_a :] = eq.bound_lower / L, eq.bound_upper / L
    h = np.zeros(len(inequality))
    return qpsolvers.Problem(P, q, inequality, h, hard, rhs, lower, upper), scale


def contact_forces(eq: BalanceEquations, options: ForceOptions | None = None) -> ForceSolution:
    """Forces that balance the object exactly and the joints as well as possible.

    The object balance is hard (mass and contact geometry are known best), the joint balance soft:
    an equality there is infeasible for nearly every measured state. Friction is exact by cutting
    planes, or by one conic program, or a polyhedron, as the options say.

    Never raises for an impossible grasp: read ``status`` and ``violation``.
    """
    options = options or ForceOptions()
    if options.friction == "cone":
        from .conic import solve_conic

        return solve_conic(eq, options)
    n_h = eq.object_matrix.shape[1]
    problem, scale = force_problem(eq, options)
    cuts = np.zeros((0, n_h))
    for solves in range(1, options.max_cuts + 1):
        solution = solve_qp(problem, options.solver)
        if not solution.found:
            return classify_failure(eq, options, cuts, solves)
        unknowns = scale * solution.x
        new = (
            cutting_planes(eq.cones, unknowns[:n_h], options.tolerance) if options.friction == "cuts" else ()
        )
        if not len(new):
            break
        cuts = np.concatenate([cuts, new])
        rows = np.zeros((len(new), len(scale)))
        rows[:, :n_h] = new * scale[:n_h]
        problem.G, problem.h = np.concatenate([problem.G, rows]), np.append(problem.h, np.zeros(len(new)))
    return unpack(eq, options, unknowns, solves)


def solve_qp(problem, solver: str):
    """Solve a ``qpsolvers.Problem``, with tight tolerances where the solver is PIQP.

    The weight of the forces is smaller than that of the joint residual by seven powers of ten: PIQP
    needs iterative refinement for that (without it, one problem in eight with joints at their stops ran
    into its limit of iterations). Should it give up nevertheless, Clarabel has the last word.
    """
    qpsolvers = require("qpsolvers")
    settings = {}
    if solver == "piqp":
        settings = {"eps_abs": 1e-10, "eps_rel": 1e-11, "iterative_refinement_always_enabled": True}
    solution = qpsolvers.solve_problem(problem, solver, **settings)
    if not solution.found and solver == "piqp" and not _certified_infeasible(solution):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # qpsolvers warns when Clarabel finds the problem infeasible
            solution = qpsolvers.solve_problem(_sparse(problem), "clarabel")
    return solution


def _certified_infeasible(solution) -> bool:
    return "PRIMAL_INFEASIBLE" in str(getattr(solution.extras.get("info"), "status", ""))


def _sparse(problem):
    """The same problem in the matrices that Clarabel wants."""
    qpsolvers, csc = require("qpsolvers"), require("scipy.sparse").csc_matrix
    G, A = (None if M is None else csc(M) for M in (problem.G, problem.A))
    return qpsolvers.Problem(csc(problem.P), problem.q, G, problem.h, A, problem.b, problem.lb, problem.ub)


def unpack(eq: BalanceEquations, options: ForceOptions, unknowns: Array, solves: int) -> ForceSolution:
    """Split ``[mu; lam; tau]`` and certify it: joint residual and object violation from the equations."""
    n_h, n_a = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1]
    mu, lam, bound = np.split(unknowns, [n_h, n_h + n_a])
    residual = eq.hand_load + eq.hand_matrix @ mu + eq.actuator_matrix @ lam
    if len(bound):
        residual = residual + eq.bound_matrix @ bound
    unbalanced = (eq.object_matrix @ mu - eq.object_load) * np.where(eq.moment_rows, 1 / options.length, 1.0)
    return ForceSolution(
        ForceStatus.SOLVED, mu, lam, bound, residual, float(np.linalg.norm(unbalanced)), solves
    )


def classify_failure(
    eq: BalanceEquations, options: ForceOptions, cuts: Array | None, solves: int
) -> ForceSolution:
    """Find out whether the balance is impossible or the solver failed."""
    problem, scale = force_problem(eq, options, cuts, soft=True)
    solution = solve_qp(problem, options.solver)
    n_h, n_a = eq.object_matrix.shape[1], eq.actuator_matrix.shape[1]
    status, violation = ForceStatus.FAILED, math.nan
    if solution.found:
        violation = unpack(eq, options, scale * solution.x, solves).violation
        if violation > 1e-6:  # else the balance is possible after all, and only the solver failed
            status = ForceStatus.NOT_GRASPABLE
    nan = np.full
    return ForceSolution(
        status,
        nan(n_h, np.nan),
        nan(n_a, np.nan),
        nan(len(eq.bound_lower), np.nan),
        nan(len(eq.hand_load), np.nan),
        violation,
        solves + 1,
    )


def margins(cones: Sequence[FrictionCone], mu: Array) -> tuple[Array, Array]:
    """Per contact ``mu_s f_n - |u|`` [N], and that relative to ``mu_s f_n``: 1 no friction used, 0 slips."""
    slack = np.array([cone.slack(mu) for cone in cones])
    limit = np.array([cone.mu_s * mu[cone.start] for cone in cones])
    relative = np.divide(slack, limit, out=np.zeros_like(slack), where=limit > 1e-12)
    return slack, relative
