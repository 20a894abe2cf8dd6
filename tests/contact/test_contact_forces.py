"""The force problem: exact where the answer is known, honest where there is none; its quadratic programs."""

import dataclasses

import clarabel
import numpy as np
import pytest
import qpsolvers
from contact_samples import THREE, held
from scipy import sparse

from torch_ekm._arrays import EqualityProgram, solve_by_active_set
from torch_ekm.contact import ForceOptions, ForceStatus, contact_forces, grasp_matrix, hand_jacobian
from torch_ekm.contact.forces import BalanceEquations, force_cost, force_problem, friction_cones, margins
from torch_ekm.exceptions import ParameterError


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


WEIGHT = np.array([0.0, 0.0, -9.81 * 0.25, 0.0, 0.0, 0.0])


def equations(load=WEIGHT, *, gamma=0.0, friction=0.6, grip=3.0, seed=0, **changes) -> BalanceEquations:
    """Three fingers, one motor per finger; the joints are at rest under known balancing forces."""
    kin = held(THREE, gamma=gamma, friction=friction, seed=seed)
    G, J = grasp_matrix(kin).numpy(), hand_jacobian(kin).numpy()
    cones = friction_cones(
        kin.models, kin.contacts.friction.tolist(), kin.contacts.torsional_friction.tolist()
    )
    wish = np.zeros(G.shape[1])
    wish[kin.normal_rows] = grip
    mu = wish + np.linalg.pinv(G) @ (-load - G @ wish)
    actuators = np.zeros((9, 3))
    for i in range(3):
        actuators[3 * i : 3 * i + 3, i] = [1.0, 0.7, 0.5]
    lam = np.array([-0.1, -0.05, -0.08])
    eq = BalanceEquations(
        object_matrix=G,
        object_load=-load,
        hand_matrix=J.T,
        actuator_matrix=actuators,
        hand_load=-(J.T @ mu + actuators @ lam),
        cones=cones,
        moment_rows=np.array([False] * 3 + [True] * 3),
        tendon=np.array([True, False, False]),
        spin_columns=tuple(at for at, row in enumerate(kin.rows) if row % 6 >= 3),
    )
    eq = dataclasses.replace(eq, **changes)
    eq.__dict__["truth"] = (mu, lam)
    return eq


def object_alone(directions, load, friction: float, gamma: float = 0.0) -> BalanceEquations:
    """Nothing is asked of the joints."""
    kin = held(directions, friction=friction, gamma=gamma)
    G, n_c = grasp_matrix(kin).numpy(), len(directions)
    return BalanceEquations(
        object_matrix=G,
        object_load=load,
        hand_matrix=np.zeros((0, G.shape[1])),
        actuator_matrix=np.zeros((0, 0)),
        hand_load=np.zeros(0),
        cones=friction_cones(kin.models, [friction] * n_c, [gamma] * n_c),
        moment_rows=np.array([False] * 3 + [True] * 3),
        tendon=np.zeros(0, bool),
        spin_columns=(3, 7) if gamma else (),
    )


@pytest.mark.parametrize("gamma", [0.0, 0.01])
def test_forces_of_an_equilibrium_are_found_exactly(gamma):
    eq = equations(friction=3.0, gamma=gamma)
    mu, lam = eq.__dict__["truth"]
    solution = contact_forces(eq)
    assert solution.status is ForceStatus.SOLVED
    assert np.linalg.norm(solution.mu - mu) < 1e-4 * np.linalg.norm(mu)
    assert np.linalg.norm(solution.lam - lam) < 1e-4 * np.linalg.norm(lam)
    assert np.abs(solution.residual).max() < 1e-5
    assert solution.violation < 1e-9


@pytest.mark.parametrize(("friction", "gamma"), [(0.45, 0.0), (0.45, 0.004)])
def test_cutting_planes_and_the_cone_program_give_the_same_forces_on_the_cone(friction, gamma):
    eq = equations(friction=friction, gamma=gamma, grip=1.0)
    cuts, cone = contact_forces(eq), cone_program(eq)
    assert cuts.solves > 2  # friction is active: otherwise this test shows nothing
    cone = cone[: len(cuts.mu)]
    for mu in (cuts.mu, cone):
        slack, relative = margins(eq.cones, mu)
        assert slack.min() > -1e-6
        assert abs(relative).min() < 1e-4
    assert np.linalg.norm(cuts.mu - cone) < 1e-3 * np.linalg.norm(cone)


def test_without_enough_friction_the_grasp_is_said_to_be_impossible():
    eq = equations(friction=0.02)
    solution = contact_forces(eq)
    assert solution.status is ForceStatus.NOT_GRASPABLE
    assert np.isnan(solution.mu).all()
    assert solution.violation > 0.1  # of 2.45 N
    assert cone_program(eq) is None


@pytest.mark.parametrize(
    ("directions", "friction", "closure"),
    [
        (THREE, 0.6, True),
        (THREE, 0.12, True),
        (THREE, 0.08, False),
        ([[1.0, 0, 0], [-1.0, 0, 0]], 0.6, False),  # nothing resists turning about their line
        ([[1.0, 0, 0], [1.0, 0.1, 0], [1.0, 0, 0.1]], 0.6, False),
    ],
)
def test_any_load_is_borne_where_there_is_force_closure_and_only_there(directions, friction, closure):
    loads = np.random.default_rng(0).normal(size=(12, 6)) * [1, 1, 1, 0.03, 0.03, 0.03]
    found = [contact_forces(object_alone(directions, load, friction)).status for load in loads]
    assert all(status is ForceStatus.SOLVED for status in found) is closure


def test_measured_normal_forces_are_respected():
    # 9 motors: the internal forces are not determined by the joint balance
    eq = equations(friction=1.0, actuator_matrix=np.eye(9), tendon=np.zeros(9, bool))
    wished = np.array([4.0, 2.5, np.nan])
    starts = [cone.start for cone in eq.cones]
    free = contact_forces(eq).mu[starts]
    measured = dataclasses.replace(eq, measured_normal=wished)
    told = contact_forces(measured, ForceOptions(normal_std=0.01)).mu[starts]
    assert np.abs(told[:2] - wished[:2]).max() < 0.1
    assert np.abs(free[:2] - wished[:2]).max() > 0.5


def test_a_tendon_never_pushes():
    eq = equations(friction=3.0)
    mu, lam = eq.__dict__["truth"]
    lam = np.array([0.1, -0.05, -0.08])  # the first tendon would have to push
    load = -(eq.hand_matrix @ mu + eq.actuator_matrix @ lam)
    solution = contact_forces(dataclasses.replace(eq, hand_load=load))
    assert solution.status is ForceStatus.SOLVED
    assert solution.lam[0] <= 1e-9
    assert np.abs(solution.residual).max() > 1e-3  # what it could not explain is reported


def test_stop_torques_are_one_sided():
    eq = equations(friction=3.0)
    torque = np.zeros(9)
    torque[4] = 0.05
    column = -np.eye(9)[:, [4]]
    loaded = dataclasses.replace(
        eq,
        hand_load=eq.hand_load + torque,
        bound_matrix=column,
        bound_lower=np.zeros(1),
        bound_upper=np.array([np.inf]),
    )
    held_by_stop = contact_forces(loaded)
    assert held_by_stop.bound[0] == pytest.approx(0.05, rel=2e-2)
    away = contact_forces(dataclasses.replace(loaded, hand_load=eq.hand_load - torque))
    assert away.bound[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("bad", [{"start_std": 0.0}, {"torque_std": 0.0}])
def test_bad_options_are_refused(bad):
    with pytest.raises(ParameterError, match=next(iter(bad))):
        ForceOptions(**bad)


def bound_normals(monkeypatch, most):
    monkeypatch.setattr("torch_ekm.contact.forces.MAX_NORMAL", most)


def test_soft_finger_bears_spin_up_to_its_coefficient(monkeypatch):
    """A torque about the line between two opposite contacts of 4 N and 5 mm: at most 0.04 N m."""
    bound_normals(monkeypatch, 4.0)
    loads = (np.array([0.0, 0, 0, moment, 0, 0]) for moment in (0.039, 0.041))
    less, more = (
        contact_forces(object_alone([[1.0, 0, 0], [-1.0, 0, 0]], load, 0.5, 0.005)) for load in loads
    )
    assert (less.status, more.status) == (ForceStatus.SOLVED, ForceStatus.NOT_GRASPABLE)
    assert less.mu[[0, 4]].max() <= 4.0 + 1e-9


def expecting(eq: BalanceEquations, seed=0, size=0.3) -> BalanceEquations:
    """Forces near the truth are expected, with a full covariance."""
    draw = np.random.default_rng(seed)
    mu, _ = eq.__dict__["truth"]
    half = draw.standard_normal((len(mu), len(mu)))
    covariance = size**2 * (half @ half.T / len(mu) + 0.1 * np.eye(len(mu)))
    for column in eq.spin_columns:
        covariance[column], covariance[:, column] = 0.03 * covariance[column], 0.03 * covariance[:, column]
    expected = draw.multivariate_normal(mu, covariance)
    return dataclasses.replace(eq, expected=expected, expected_covariance=covariance)


@pytest.mark.parametrize("gamma", [0.0, 0.01])
@pytest.mark.parametrize("measured", [{}, {"measured_normal": np.array([3.1, np.nan, 2.7])}])
def test_expected_forces_and_measurements_give_the_gaussian_posterior(gamma, measured):
    eq, options = expecting(equations(friction=3.0, gamma=gamma, **measured)), ForceOptions()
    solution = contact_forces(eq, options)
    mean, covariance = gaussian_posterior(eq, options)
    n_h = len(solution.mu)
    assert solution.solves == 0  # no inequality acts
    assert np.abs(solution.mu - mean[:n_h]).max() < 1e-4
    assert np.abs(solution.covariance - covariance[:n_h, :n_h]).max() < 5e-4 * covariance.max()
    assert solution.violation < 1e-9


def test_forces_stay_in_balance_and_in_the_cones_whatever_is_expected():
    eq = expecting(equations(friction=0.5, grip=1.5), size=0.3)
    eq = dataclasses.replace(eq, expected=eq.expected + np.tile([-1.0, 2.0, -1.5], 3))
    solution = contact_forces(eq)
    assert solution.status is ForceStatus.SOLVED
    assert solution.solves > 0
    assert margins(eq.cones, solution.mu)[0].min() > -1e-6
    assert solution.violation < 1e-8


def test_the_answer_without_inequalities_is_taken_only_where_it_keeps_them(monkeypatch):
    free = equations(friction=3.0)
    assert contact_forces(free).solves == 0
    starts = [cone.start for cone in free.cones]
    assert contact_forces(free).mu[starts].max() > 2.6
    bound_normals(monkeypatch, 2.5)
    low = contact_forces(free).mu[starts]
    assert low.max() < 2.5 + 1e-6


def drawn(seed: int, n: int = 10):
    draw = np.random.default_rng(seed)
    m, k = 2, 12
    root = draw.normal(size=(n, n))
    A, G = draw.normal(size=(m, n)), draw.normal(size=(k, n))
    x = draw.normal(size=n)  # keeps all rows: there is an optimum
    return root @ root.T + 0.1 * np.eye(n), 5 * draw.normal(size=n), A, A @ x, G, G @ x + draw.uniform(size=k)


def certify(P, q, A, b, G, h, found) -> None:
    """Keeps the conditions of Karush, Kuhn and Tucker; PIQP agrees; its rows lead to it again."""
    slope = P @ found.x + q + found.equality @ A + found.inequality @ G[found.active]
    np.testing.assert_allclose(slope, 0, atol=1e-9)
    np.testing.assert_allclose(A @ found.x, b, atol=1e-9)
    assert (G @ found.x <= h + 1e-9).all()
    assert (found.inequality >= 0).all()
    problem = qpsolvers.Problem(P, q, G, h, A, b)
    other = qpsolvers.solve_problem(problem, "piqp", eps_abs=1e-11, eps_rel=1e-11)
    np.testing.assert_allclose(found.x, other.x, rtol=0, atol=1e-6)
    again = solve_by_active_set(EqualityProgram(P, q, A, b), G, h, found.active)
    np.testing.assert_allclose(again.x, found.x, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_the_optimum_and_its_certificate(seed: int) -> None:
    P, q, A, b, G, h = drawn(seed)
    found = solve_by_active_set(EqualityProgram(P, q, A, b), G, h, [])
    certify(P, q, A, b, G, h, found)


def test_rows_that_contradict_each_other_are_left_to_another_method() -> None:
    P, q, A, b, _, _ = drawn(0)
    G = np.stack([np.eye(10)[0], -np.eye(10)[0]])
    assert solve_by_active_set(EqualityProgram(P, q, A, b), G, np.array([-1.0, -1.0]), []) is None
