"""Unilateral laws and Coulomb friction: closed answers, derivatives, and a second-order cone program."""

from __future__ import annotations

import dataclasses

import clarabel
import numpy as np
import pytest
from scipy import sparse

from torch_ekm.model.moving_contacts import contact_laws
from torch_ekm.model.moving_contacts.contact_laws import StepProblem, StepSolution, solve

MU = 0.5


def block(push: float, side: float, *, gap: float = 0.0, stiffness: float = 2.0) -> StepProblem:
    """A block on springs in the plane: z = (x along a wall, y off it), pushed along it and onto it."""
    return StepProblem(
        D=stiffness * np.eye(2),
        load=np.array([-side, push]),
        E=np.array([[0.0, 1.0]]),
        gap=np.array([gap]),
        compliance=np.zeros(1),
        before=np.zeros(1),
        one_sided=np.array([True]),
        T=np.array([[[-1.0, 0.0]]]),  # the wall against the block
        way=np.zeros((1, 1)),
        tangential_compliance=0.0,
        t_before=np.zeros((1, 1)),
        mu_s=np.array([MU]),
    )


def answer(problem: StepProblem) -> StepSolution:
    n_c, d = problem.way.shape
    found = solve(problem, np.zeros(len(problem.gap)), np.zeros((n_c, d)))
    assert found is not None
    return found


def test_a_block_that_is_pushed_inside_its_cone_stays() -> None:
    found = answer(block(push=1.0, side=0.4))
    np.testing.assert_allclose(found.z, 0.0, atol=1e-12)
    np.testing.assert_allclose([*found.lam, *found.t.ravel()], [1.0, -0.4], atol=1e-12)
    assert not found.slides[0]


@pytest.mark.parametrize("side", [0.7, -0.7])
def test_a_block_that_is_pushed_beyond_its_cone_slides_until_its_spring_bears_the_rest(side: float) -> None:
    found = answer(block(push=1.0, side=side))
    rest = (abs(side) - MU) / 2.0
    np.testing.assert_allclose(found.z, [np.sign(side) * rest, 0.0], atol=1e-12)
    assert abs(found.t[0, 0]) == pytest.approx(MU)
    assert found.slides[0]
    # the harder it is pressed, the less it slides: dx/dpush = -mu/k
    rate = found.response(np.array([[0.0], [1.0]]), np.zeros((1, 1)))
    assert rate.z[0, 0] == pytest.approx(-np.sign(side) * MU / 2.0)


def test_a_contact_that_slides_and_bears_nothing_answers_with_numbers() -> None:
    """Where rounding puts a contact on the edge between sliding and open."""
    found = answer(block(push=1.0, side=0.7))
    edge = found._replace(lam=0 * found.lam, t=0 * found.t)
    rate = edge.response(np.array([[0.0], [1.0]]), np.ones((1, 1)))
    assert all(np.isfinite(part).all() for part in rate)


def test_a_block_that_is_pulled_off_opens() -> None:
    found = answer(block(push=-1.0, side=0.3))
    np.testing.assert_allclose(found.z, [0.15, 0.5], atol=1e-12)
    assert not found.active[0]
    np.testing.assert_array_equal(found.t, 0.0)


def test_a_gap_closes_and_what_is_left_of_the_push_is_borne() -> None:
    found = answer(block(push=1.0, side=0.0, gap=0.2))
    assert found.z[1] == pytest.approx(-0.2)
    assert found.lam[0] == pytest.approx(1.0 - 2.0 * 0.2)
    far = answer(block(push=1.0, side=0.0, gap=0.6))
    assert far.z[1] == pytest.approx(-0.5)
    assert not far.active[0]


def test_a_compliant_tendon_pulls_by_what_it_is_stretched_and_never_pushes() -> None:
    rope = dataclasses.replace(
        block(push=0.0, side=0.0), mu_s=np.zeros(1), T=np.zeros((1, 1, 2)), E=np.array([[1.0, 0.0]]),
        gap=np.array([-0.3]), compliance=np.array([1 / 4.0]),
    )  # fmt: skip
    found = answer(rope)  # k x = p, p = K (0.3 - x)
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


def cone_program(p: StepProblem, sweeps: int = 400) -> np.ndarray:
    """min z'Dz/2 + load'z with (w + mu |v|, v) in the dual cones, |v| that of the sweep before: its fixed
    point is Coulomb friction (De Saxce)."""
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = (
        False,
        1e-11,
        1e-11,
        1e-11,
    )
    n_c, d, n_z = p.T.shape
    z, slide = np.zeros(n_z), np.zeros(n_c)
    for _ in range(sweeps):
        rows, rhs = [], []
        for i in range(n_c):
            rows += [-p.E[i : i + 1] / p.mu_s[i], -p.T[i]]
            rhs += [(p.gap[i] + p.mu_s[i] * slide[i]) / p.mu_s[i], *p.way[i]]
        cones = [clarabel.SecondOrderConeT(1 + d)] * n_c
        A = sparse.csc_matrix(np.concatenate(rows))
        solver = clarabel.DefaultSolver(
            sparse.csc_matrix(np.triu(p.D)), p.load, A, np.array(rhs), cones, settings
        )
        new = np.array(solver.solve().x)
        slide = np.linalg.norm(p.slides(new, p.t_before), axis=1)
        if np.abs(new - z).max() < 5e-8:  # interior points do not settle further on every processor
            return new
        z = new
    pytest.fail("the sweeps do not settle")


@pytest.mark.parametrize("seed", range(6))
def test_newton_finds_what_a_cone_program_finds(seed: int) -> None:
    problem = random_problem(seed)
    np.testing.assert_allclose(answer(problem).z, cone_program(problem), atol=2e-6)


@pytest.mark.parametrize("seed", range(20))
def test_the_answer_keeps_every_law(seed: int) -> None:
    p = random_problem(seed, n_c=6)
    found = answer(p)
    w, v, size = p.gaps(found.z, found.lam), p.slides(found.z, found.t), np.linalg.norm(found.t, axis=1)
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


def test_where_newton_alone_goes_round_in_circles_splitting_helps() -> None:
    problems = [random_problem(seed, n_c=6) for seed in range(40)]
    alone = [contact_laws._newton(p, np.zeros(14), np.zeros(6), np.zeros((6, 2))) for p in problems]
    assert any(found is None for found in alone)
    assert all(solve(p, np.zeros(6), np.zeros((6, 2))) is not None for p in problems)
