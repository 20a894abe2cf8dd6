"""Small quadratic programs: the active set finds the optimum, or says that it does not."""

from __future__ import annotations

import numpy as np
import pytest
import qpsolvers

from torch_ekm.contact.forces.active_set import EqualityProgram, solve_by_active_set


def drawn(seed: int, n: int = 10):
    draw = np.random.default_rng(seed)
    m, k = 2, 12
    root = draw.normal(size=(n, n))
    A, G = draw.normal(size=(m, n)), draw.normal(size=(k, n))
    x = draw.normal(size=n)  # keeps all rows: there is an optimum
    return root @ root.T + 0.1 * np.eye(n), 5 * draw.normal(size=n), A, A @ x, G, G @ x + draw.uniform(size=k)


@pytest.mark.parametrize("seed", range(20))
def test_the_optimum_and_its_certificate(seed: int) -> None:
    P, q, A, b, G, h = drawn(seed)
    found = solve_by_active_set(EqualityProgram(P, q, A, b), G, h, [])
    assert found is not None
    slope = P @ found.x + q + found.equality @ A + found.inequality @ G[found.active]
    np.testing.assert_allclose(slope, 0, atol=1e-9)
    np.testing.assert_allclose(A @ found.x, b, atol=1e-9)
    assert (G @ found.x <= h + 1e-9).all()
    assert (found.inequality >= 0).all()
    problem = qpsolvers.Problem(P, q, G, h, A, b)
    other = qpsolvers.solve_problem(problem, "piqp", eps_abs=1e-11, eps_rel=1e-11)
    np.testing.assert_allclose(found.x, other.x, rtol=0, atol=1e-6)
    again = solve_by_active_set(EqualityProgram(P, q, A, b), G, h, found.active)
    assert again is not None
    np.testing.assert_allclose(again.x, found.x, atol=1e-12)


def test_at_a_vertex_it_may_find_none_but_nothing_wrong() -> None:
    """With as many rows as unknowns the next row has no multipliers: rounding decides which row leaves."""
    answers = 0
    for seed in range(20):
        P, q, A, b, G, h = drawn(seed, n=8)
        found = solve_by_active_set(EqualityProgram(P, q, A, b), G, h, [])
        if found is not None:
            other = qpsolvers.solve_problem(qpsolvers.Problem(P, q, G, h, A, b), "piqp")
            np.testing.assert_allclose(found.x, other.x, rtol=0, atol=1e-5)
            answers += 1
    assert answers >= 17


def test_rows_that_contradict_each_other_are_left_to_another_method() -> None:
    P, q, A, b, _, _ = drawn(0)
    G = np.stack([np.eye(10)[0], -np.eye(10)[0]])
    assert solve_by_active_set(EqualityProgram(P, q, A, b), G, np.array([-1.0, -1.0]), []) is None


@pytest.mark.parametrize("seed", range(5))
def test_more_equations_than_unknowns_give_no_answer(seed: int) -> None:
    draw = np.random.default_rng(seed)
    try:
        program = EqualityProgram(np.eye(3), np.zeros(3), draw.normal(size=(6, 3)), draw.normal(size=6))
    except np.linalg.LinAlgError:  # rounding mostly hides it
        return
    assert solve_by_active_set(program, np.zeros((0, 3)), np.zeros(0), []) is None
