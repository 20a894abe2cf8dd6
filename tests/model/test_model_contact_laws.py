"""Unilateral laws and Coulomb friction: each answer keeps them all; its derivatives."""

import dataclasses

import numpy as np
import pytest

from torch_ekm.model import contact_laws
from torch_ekm.model.contact_laws import StepProblem, StepSolution, solve


def answer(problem: StepProblem) -> StepSolution:
    n_c, d = problem.way.shape
    return solve(problem, np.zeros(len(problem.gap)), np.zeros((n_c, d)))


def test_a_compliant_tendon_pulls_by_what_it_is_stretched_and_never_pushes() -> None:
    """``p = K (0.3 - x)`` on a spring: ``k x = p``."""
    rope = StepProblem(
        D=2.0 * np.eye(1), load=np.zeros(1), E=np.ones((1, 1)), gap=np.array([-0.3]),
        compliance=np.array([1 / 4.0]), before=np.zeros(1), one_sided=np.array([True]),
        T=np.zeros((1, 1, 1)), way=np.zeros((1, 1)),
        tangential_compliance=0.0, t_before=np.zeros((1, 1)), mu_s=np.zeros(1),
    )  # fmt: skip
    found = answer(rope)
    assert found.lam[0] == pytest.approx(0.3 / (1 / 2.0 + 1 / 4.0))
    assert found.z[0] == pytest.approx(found.lam[0] / 2.0)
    slack = answer(dataclasses.replace(rope, gap=np.array([0.3])))
    np.testing.assert_allclose(slack.z, 0.0, atol=1e-12)


def random_problem(seed: int, n_c: int = 4, n_z: int = 14) -> StepProblem:
    """Contacts with friction in space, more or less pressed, some of them open."""
    draw = np.random.default_rng(seed)
    root = draw.normal(size=(n_z, n_z))
    return StepProblem(
        D=root @ root.T / n_z + 0.2 * np.eye(n_z),
        load=draw.normal(size=n_z),
        E=draw.normal(size=(n_c, n_z)),
        gap=draw.normal(size=n_c) * 0.2 + 0.1,
        compliance=np.zeros(n_c),
        before=np.zeros(n_c),
        one_sided=np.ones(n_c, bool),
        T=draw.normal(size=(n_c, 2, n_z)),
        way=np.zeros((n_c, 2)),
        tangential_compliance=0.0,
        t_before=np.zeros((n_c, 2)),
        mu_s=draw.uniform(0.3, 1.0, size=n_c),
    )


@pytest.mark.parametrize("seed", range(20))
def test_the_answer_keeps_every_law(seed: int) -> None:
    p = random_problem(seed, n_c=6)
    found = answer(p)
    w, v, size = p.gap + p.E @ found.z, p.T @ found.z, np.linalg.norm(found.t, axis=1)  # of rigid contacts
    balance = p.D @ found.z + p.load - p.E.T @ found.lam + np.einsum("idz,id->z", p.T, found.t)
    assert np.abs(balance).max() < 1e-9
    assert min(w.min(), found.lam.min()) > -1e-9
    assert np.abs(w * found.lam).max() < 1e-8
    assert (size <= p.mu_s * found.lam + 1e-9).all()
    for i in range(6):
        speed = np.linalg.norm(v[i])
        if found.lam[i] > 1e-9 and speed > 1e-8:
            np.testing.assert_allclose(found.t[i], p.mu_s[i] * found.lam[i] * v[i] / speed, atol=1e-7)


@pytest.mark.parametrize("seed", range(6))
def test_the_derivative_is_that_of_the_answer(seed: int) -> None:
    p, h = random_problem(seed), 1e-4
    load, gap = np.eye(len(p.load))[:, :3], np.zeros((4, 3))
    gap[0, 2] = 1.0
    rate = answer(p).response(load, gap)
    for k in range(3):
        ends = [
            answer(dataclasses.replace(p, load=p.load + s * h * load[:, k], gap=p.gap + s * h * gap[:, k]))
            for s in (1, -1)
        ]
        np.testing.assert_allclose((ends[0].z - ends[1].z) / (2 * h), rate.z[:, k], atol=1e-5)
        np.testing.assert_allclose((ends[0].lam - ends[1].lam) / (2 * h), rate.lam[:, k], atol=1e-5)


def test_a_contact_that_slides_and_bears_nothing_answers_with_numbers() -> None:
    """Where rounding puts contacts on the edge between sliding and open."""
    p = random_problem(0)
    found = answer(p)
    edge = found._replace(lam=0 * found.lam, t=0 * found.t, slides=np.ones(4, bool))
    rate = edge.response(np.eye(len(p.load))[:, :3], np.ones((4, 3)))
    assert all(np.isfinite(part).all() for part in rate)


def test_where_newton_alone_goes_round_in_circles_splitting_helps() -> None:
    problems = [random_problem(seed, n_c=6) for seed in range(40)]
    alone = [contact_laws._newton(p, np.zeros(14), np.zeros(6), np.zeros((6, 2))) for p in problems]
    assert any(found is None for found in alone)
    assert all(solve(p, np.zeros(6), np.zeros((6, 2))) is not None for p in problems)
