"""The controller's quadratic program."""

import math

import numpy as np
import pytest

from torch_ekm.control import Bounds, Equality, Inequality, Squares
from torch_ekm.control.program import ControlSolution, build_qp
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError

DEG = math.pi / 180
EFFORT = Squares(np.diag([1.0, 2.0]), np.zeros(2))  # u1^2 + 4 u2^2
E = np.array([[1.0, 2.0]])


def solve(*rows, d: float = 0.1, bound: float = 1.0) -> ControlSolution:
    """Rows beside ``u1 + 2 u2 = d`` and the effort."""
    always = (EFFORT, Equality(E, np.array([d])), Bounds(np.full(2, -bound), np.full(2, bound)))
    return build_qp(2, [*always, *rows]).solve()


def test_weighted_least_norm_step() -> None:
    # min u1^2 + 4 u2^2 with u1 + 2 u2 = d: u = W^-1 E^T (E W^-1 E^T)^-1 d = (1/2, 1/4) d
    solution = solve()
    np.testing.assert_allclose(solution.u, [0.05, 0.025], atol=1e-8)
    np.testing.assert_allclose(solution.slack, 0, atol=1e-8)


def test_unreachable_target_goes_to_the_bounds_and_says_so() -> None:
    solution = solve(d=0.9, bound=0.2)
    np.testing.assert_allclose(solution.u, [0.2, 0.2], atol=1e-6)
    np.testing.assert_allclose(solution.slack, 0.3, atol=1e-5)


@pytest.mark.parametrize(("d", "u"), [(0.9, [0.03, 0.2]), (-0.9, [-0.2, 0.04])])
def test_bounds_intersect(d: float, u: list[float]) -> None:
    row = Bounds(np.array([-1.0, 0.04]), np.array([0.03, 1.0]))
    np.testing.assert_allclose(solve(row, d=d, bound=0.2).u, u, atol=1e-6)


def test_l1_slack_is_exact_when_the_target_is_reachable() -> None:
    # a quadratic slack of any weight would leave a part of the target unmet
    solution = solve(Squares(np.array([[1.0, 0.0]]), np.array([-0.1]), 3.0, DEG))
    np.testing.assert_allclose(solution.slack, 0, atol=1e-7)


def test_soft_inequality_holds_if_it_can_and_yields_if_it_must() -> None:
    solution = solve(Inequality(np.array([[1.0, 0.0]]), np.array([0.01]), DEG))
    assert solution.u[0] <= 0.01 + 1e-7
    contradictory = Inequality(np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-0.1, -0.1]))
    assert abs(solve(contradictory).u[0]) < 0.1


def test_cheaper_of_two_limits_is_broken() -> None:
    up, down = (
        Inequality(np.array([[s, 0.0]]), np.array([-0.1]), DEG, p) for s, p in ((1, 10.0), (-1, 20.0))
    )
    assert solve(up, down, d=0.0).u[0] == pytest.approx(0.1, abs=1e-6)


def test_squares_pull_and_weigh_each_row_in_its_unit() -> None:
    rows = Squares(np.eye(2), np.array([0.1, 0.1]), np.array([1.0, 4.0]), np.array([1.0, 2.0]))
    free = build_qp(2, [Squares(np.eye(2), np.zeros(2)), rows]).solve()
    np.testing.assert_allclose(free.u, [0.05, 0.05], atol=1e-7)


def test_rows_that_ask_for_nothing() -> None:
    np.testing.assert_array_equal(solve(None).u, solve().u)


def test_bad_problem_is_refused() -> None:
    eye, zero, one = np.eye(2), np.zeros(2), np.ones(2)
    for row, error, said in (
        (Bounds(np.array([1.0, 0.0]), np.array([-1.0, 1.0])), ParameterError, r"lower\[0\].*upper\[0\] = -1"),
        (Equality(np.array([[np.nan, 1.0]]), one[:1]), NonFiniteError, "A, b of Equality must be finite"),
        (Squares(eye, zero[:1]), ShapeError, r"b of Squares must have shape \(2,\), got \(1,\)"),
        (Inequality(eye, np.zeros((2, 1))), ShapeError, "h of Inequality"),
        (Bounds(zero, np.ones(3)), ShapeError, r"upper of Bounds must have shape \(2,\), got \(3,\)"),
        (Bounds(np.array([np.nan, 0.0]), one), ParameterError, r"lower of Bounds = \[nan, 0"),
        (Squares(eye, zero, unit=0.0), ParameterError, "unit of Squares"),
    ):
        with pytest.raises(error, match=said):
            build_qp(2, [row])


def test_without_slack_the_active_set_finds_what_piqp_finds() -> None:
    n, draw, found = 4, np.random.default_rng(0), 0
    for _ in range(20):
        rows = [
            Squares(np.eye(n), np.zeros(n), 1e-2, DEG),
            Squares(draw.normal(size=(3, n)), 0.02 * draw.normal(size=3), 1.0, DEG),
            Equality(draw.normal(size=(1, n)), np.array([0.02])),
            Inequality(draw.normal(size=(4, n)), 0.01 * draw.uniform(size=4), DEG),
            Bounds(np.full(n, -0.05), np.full(n, 0.03)),
        ]
        problem = build_qp(n, rows)
        ours = problem._without_slack()
        if ours is not None:  # None: a row must give way
            found += 1
            np.testing.assert_allclose(ours, problem._by_piqp(), rtol=0, atol=1e-6)
    assert 5 < found < 20


def test_a_limit_that_costs_less_than_the_wish_gives_way() -> None:
    wish = Squares(np.eye(1), np.array([0.1]), 1.0, DEG)
    limit = Inequality(np.eye(1), np.array([0.05]), DEG, penalty=1e-3)
    assert build_qp(1, [wish, limit]).solve().u[0] == pytest.approx(0.1, abs=1e-4)
