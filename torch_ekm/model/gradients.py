"""What autograd cannot see: forces from a QP, contacts from a collision detector.

Both are found without gradients; the implicit function theorem then gives their derivative. Let ``x*`` solve
``r(x, theta) = 0`` at given theta. In

    x = x* - (dr/dx)^-1 (r(x*, theta) - r(x*, theta*))        theta* = theta, held constant

the bracket is 0, so the value is ``x*``, and its derivative is ``-(dr/dx)^-1 dr/dtheta``. First order only.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from .._extras import require
from ..contact.contacts import VARYING, ContactSet
from ..contact.forces import BalanceEquations, ForceOptions, ForceSolution, force_cost, force_problem
from ..exceptions import NoContactError
from ..kinematics.poses import GraspState
from ..typing import Float, Tensor

_NEAR = 1e-3  # [N] constraints with less room may be active: an interior-point method stays off them a little
_ACTIVE = 1e-9  # and are, if their multiplier is larger (the solver's tolerance is 1e-10)
_STEP = 1e-6  # [rad, m] of the detector's central differences: its own rounding is about 1e-12


def following(
    contacts: ContactSet, detect: Callable[[GraspState], ContactSet], state: GraspState
) -> ContactSet:
    """The detected contacts, with their derivative along the state by central differences.

    Of point, normal, gap and curvatures, along those parts of the state that require a gradient. Where a
    small step changes who touches, that direction has no derivative and counts as 0.
    """
    here = GraspState(state.q.detach(), state.position.detach(), state.rotation.detach())
    parts = (state.q, here.n_s - 6), (state.position, 3), (state.rotation, 3)
    asked = [part.requires_grad for part, size in parts for _ in range(size)]
    if not any(asked):
        return contacts
    columns: dict[str, list[Tensor]] = {name: [] for name in VARYING}
    for ds in _STEP * torch.eye(here.n_s, dtype=here.q.dtype)[asked]:
        ends = [contacts, contacts]
        with contextlib.suppress(NoContactError):
            moved = [detect(here.plus(way)) for way in (ds, -ds)]
            ends = moved if all(end.finger == contacts.finger for end in moved) else ends
        for name in VARYING:
            columns[name].append((getattr(ends[0], name) - getattr(ends[1], name)) / (2 * _STEP))
    ds = state.minus(here)[asked]  # 0, with the derivative of the state
    return contacts.replace(
        **{name: getattr(contacts, name) + torch.stack(columns[name], dim=-1) @ ds for name in VARYING}
    )


def differentiable_forces(
    eq: BalanceEquations,
    options: ForceOptions,
    solution: ForceSolution,
    object_matrix: Tensor,
    object_load: Tensor,
    hand_matrix: Tensor,
    hand_load: Tensor,
    actuator_matrix: Tensor,
    closed: Tensor | None,
) -> tuple[Float[Tensor, " n_h"], Float[Tensor, " n_a"], Float[Tensor, " n_z"]]:
    """``mu``, ``lam`` and the joint residual of a solved problem, with their derivative at its active set.

    ```
    r = [ M^T W (M x + b) + G^T nu + ... ]      stationarity; what is left out does not depend on theta
        [ G x - V_p                      ]      object balance; active cones and bounds stay active
    ```

    Args:
        eq, options, solution: the problem and its answer.
        object_matrix, object_load, hand_matrix, hand_load, actuator_matrix: as in ``eq``, with a graph.
        closed: the last columns of its bound matrix, of loops, likewise.
    """
    cost = force_cost(eq, options)
    problem, scale = force_problem(eq, cost), cost.scale
    n_h, n_a, n = len(solution.mu), len(solution.lam), len(scale)
    x = np.concatenate([solution.mu, solution.lam, solution.bound]) / scale
    P, A = cost.P, cost.balance
    slope = P @ x + cost.q
    rows, curvature = _active(eq, solution.mu, x, scale, problem.lb, problem.ub)
    n_e = len(A)
    # inequalities push one way only
    signed, _ = require("scipy.optimize").nnls(np.concatenate([A.T, -A.T, rows.T], axis=1), -slope)
    nu = np.concatenate([signed[:n_e] - signed[n_e : 2 * n_e], signed[2 * n_e :]])
    keep = np.concatenate([np.ones(n_e, bool), nu[n_e:] > _ACTIVE])
    for at, bend in enumerate(curvature, start=n_e):
        if keep[at] and bend is not None:
            P = P + nu[at] * bend
    E = np.concatenate([A, rows])[keep]
    K = np.block([[P, E.T], [E, np.zeros((len(E), len(E)))]])

    def tensor(value: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(value)).to(hand_load)

    x_t, s = tensor(x), tensor(scale)
    row_scale = tensor(eq.row_scale)
    G = object_matrix * row_scale[:, None] * s[:n_h]
    bound = tensor(eq.bound_matrix.reshape(len(eq.hand_load), n - n_h - n_a))
    if closed is not None:
        bound = torch.cat([bound[:, : bound.shape[1] - closed.shape[1]], closed], dim=1)
    M = torch.cat([hand_matrix, actuator_matrix, bound], dim=1) * s
    stationary = M.mT @ (M @ x_t + hand_load) / options.torque_std**2
    stationary = stationary + torch.nn.functional.pad(G.mT @ tensor(nu[:n_e]), (0, n - n_h))
    balance = G @ x_t[:n_h] - object_load * row_scale
    r = torch.cat([stationary, balance, stationary.new_zeros(len(E) - n_e)])
    inverse = tensor(np.linalg.pinv(K, rcond=1e-15))
    x_t = x_t - inverse[:n] @ (r - r.detach())
    mu, lam, _ = (s * x_t).split([n_h, n_a, n - n_h - n_a])
    return mu, lam, M @ x_t + hand_load


def _active(
    eq: BalanceEquations, mu: np.ndarray, x: np.ndarray, scale: np.ndarray, lower: Any, upper: Any
) -> tuple[np.ndarray, list[np.ndarray | None]]:
    """Gradients of the active cones and bounds in the problem's unknowns, and the cones' curvature."""
    n, n_h = len(x), len(mu)
    rows: list[np.ndarray] = []
    curvature: list[np.ndarray | None] = []
    for cone in eq.cones:
        u = cone.u(mu)
        size = float(np.linalg.norm(u))
        if cone.dim and size > _NEAR and cone.slack(mu) < _NEAR:
            row = np.zeros(n)
            row[:n_h] = cone.rows((u / size)[None], n_h)[0] * scale[:n_h]
            at = slice(cone.start + 1, cone.start + 1 + cone.dim)
            into = cone.scale * scale[at]  # unknowns to u
            bend = np.zeros((n, n))
            bend[at, at] = into[:, None] * (np.eye(cone.dim) - np.outer(u, u) / size**2) / size * into
            rows.append(row)
            curvature.append(bend)
    for bound, sign in ((lower, -1.0), (upper, 1.0)):
        for j in np.flatnonzero(np.abs(x - bound) < _NEAR):
            row = np.zeros(n)
            row[j] = sign
            rows.append(row)
            curvature.append(None)
    return np.array(rows).reshape(len(rows), n), curvature
