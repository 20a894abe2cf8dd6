"""The controller's quadratic program."""

from __future__ import annotations

import numpy as np
import pytest

from torch_ekm.control.qp import ControlProblem, build_qp, solve_qp
from torch_ekm.exceptions import ParameterError


def problem(d: float = 1.0, bound: float = 10.0, **changes) -> ControlProblem:
    fields = {
        "weight": np.diag([1.0, 4.0]),
        "lower": np.full(2, -bound),
        "upper": np.full(2, bound),
        "equality": (np.array([[1.0, 2.0]]), np.array([d])),
    }
    return ControlProblem(**(fields | changes))


def test_weighted_least_norm_step() -> None:
    # min u1^2 + 4 u2^2 with u1 + 2 u2 = 1: u = W^-1 E^T (E W^-1 E^T)^-1 = (1/2, 1/4)
    solution = solve_qp(problem())
    np.testing.assert_allclose(solution.u, [0.5, 0.25], atol=1e-7)
    np.testing.assert_allclose(solution.slack, 0, atol=1e-7)
    assert solution.primal_residual < 1e-6
    assert not solution.at_bounds.any()


def test_zero_error_gives_zero_command() -> None:
    np.testing.assert_allclose(solve_qp(problem(d=0.0)).u, 0, atol=1e-9)


def test_unreachable_target_goes_to_the_bounds_and_says_so() -> None:
    solution = solve_qp(problem(d=30.0, bound=2.0))
    np.testing.assert_allclose(solution.u, [2, 2], atol=1e-5)
    np.testing.assert_allclose(solution.slack, 24, atol=1e-4)
    assert solution.at_bounds.all()


def test_l1_slack_is_exact_when_the_target_is_reachable() -> None:
    # a quadratic slack of any weight would leave a part of the target unmet
    row = (np.array([[1.0, 0.0]]), np.array([-5.0]), np.array([3.0]))
    solution = solve_qp(problem(least_squares=[row]))
    np.testing.assert_allclose(solution.slack, 0, atol=1e-6)


def test_soft_inequality_holds_if_it_can_and_yields_if_it_must() -> None:
    rows = [(np.array([[1.0, 0.0]]), np.array([0.1]))]
    solution = solve_qp(problem(soft_inequality=rows))
    assert solution.u[0] <= 0.1 + 1e-6
    assert solution.violation < 1e-6
    contradictory = [(np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-1.0, -1.0]))]
    assert solve_qp(problem(soft_inequality=contradictory)).violation > 0.99


def test_least_squares_rows_pull() -> None:
    free = problem(equality=(np.zeros((0, 2)), np.zeros(0)))
    free.least_squares = [(np.eye(2), np.array([1.0, 1.0]), np.array([1.0, 4.0]))]
    np.testing.assert_allclose(solve_qp(free).u, [0.5, 0.5], atol=1e-6)


@pytest.mark.filterwarnings("ignore::UserWarning")  # dense matrices are copied for sparse solvers
def test_every_installed_solver_agrees() -> None:
    import qpsolvers

    reference = solve_qp(problem(soft_inequality=[(np.array([[1.0, 0.0]]), np.array([0.1]))])).u
    for solver in qpsolvers.available_solvers:
        u = solve_qp(problem(soft_inequality=[(np.array([[1.0, 0.0]]), np.array([0.1]))]), solver).u
        np.testing.assert_allclose(u, reference, atol=1e-4, err_msg=solver)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"lower": np.array([1.0, 0.0]), "upper": np.array([0.0, 1.0])}, r"lower\[0\]"),
        ({"equality": (np.array([[np.nan, 1.0]]), np.array([1.0]))}, "finite"),
    ],
)
def test_bad_problem_is_refused(changes: dict, match: str) -> None:
    with pytest.raises(ParameterError, match=match):
        build_qp(problem(**changes))


def test_unknown_solver_lists_the_installed_ones() -> None:
    with pytest.raises(ParameterError, match="piqp"):
        solve_qp(problem(), "no_such_solver")
