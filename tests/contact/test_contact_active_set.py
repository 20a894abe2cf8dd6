"""Small quadratic programs: the active set finds the optimum, or says that it does not."""

from __future__ import annotations

import numpy as np
import pytest
import qpsolvers

from torch_ekm.contact.forces.solve import EqualityProgram, solve_by_active_set


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
    assert again is not None
    np.testing.assert_allclose(again.x, found.x, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_the_optimum_and_its_certificate(seed: int) -> None:
    P, q, A, b, G, h = drawn(seed)
    found = solve_by_active_set(EqualityProgram(P, q, A, b), G, h, [])
    assert found is not None
    certify(P, q, A, b, G, h, found)


def test_at_a_vertex_it_may_find_none_but_nothing_wrong() -> None:
    """With as many rows as unknowns the next row has no multipliers: rounding decides which row leaves."""
    programs = [drawn(seed, n=8) for seed in range(20)]
    answers = [solve_by_active_set(EqualityProgram(*program[:4]), *program[4:], []) for program in programs]
    for program, found in zip(programs, answers, strict=True):
        if found is not None:
            certify(*program, found)
    assert answers.count(None) <= 1


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
