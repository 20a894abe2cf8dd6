"""One update for all estimates: Bayes' rule, and the recursions that the estimators state."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torch_ekm.estimation.force_sensitivity import ForceSensitivity
from torch_ekm.estimation.parameter_filter import ParameterFilter, surprise, update
from torch_ekm.inspection.health import _Watch

BATCH, N, M = 5, 4, 3
F64 = torch.float64


@pytest.fixture
def draw() -> np.random.Generator:
    return np.random.default_rng(0)


def covariance(draw: np.random.Generator, n: int) -> np.ndarray:
    A = draw.normal(size=(BATCH, n, n))
    return A @ A.mT + 0.1 * np.eye(n)


def test_it_is_bayes_rule_for_each_of_a_batch(draw) -> None:
    m, P, H = draw.normal(size=(BATCH, N)), covariance(draw, N), draw.normal(size=(BATCH, M, N))
    R, y, x_0 = covariance(draw, M), draw.normal(size=(BATCH, M)), draw.normal(size=(BATCH, N))
    information = np.linalg.inv(P) + H.mT @ np.linalg.inv(R) @ H
    right = np.linalg.solve(P, m[..., None]) + H.mT @ np.linalg.solve(R, y[..., None])
    exact = np.linalg.solve(information, right)[..., 0]
    residual = y - (H @ x_0[..., None])[..., 0]
    mean, left = update(m, P, residual, H, R, at=x_0)
    np.testing.assert_allclose(mean, exact, rtol=1e-9)
    np.testing.assert_allclose(left, np.linalg.inv(information), rtol=1e-9, atol=1e-12)
    variance = R.diagonal(axis1=-2, axis2=-1)
    together = update(m, P, residual, H, variance)
    for k in range(BATCH):
        alone = update(m[k], P[k], residual[k], H[k], np.diag(variance[k]))
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-9)
    bounded, same = update(m, P, residual, H, R, at=x_0, bounds=(exact.min(), exact.mean()))
    np.testing.assert_allclose(bounded, exact.clip(exact.min(), exact.mean()), rtol=1e-9)
    assert np.array_equal(same, left)


def test_a_surprise_is_one_on_average_where_the_noise_is_as_stated(draw) -> None:
    P, H, R = covariance(draw, N)[0], draw.normal(size=(M, N)), draw.uniform(0.1, 1.0, M)
    S = np.linalg.cholesky(H @ P @ H.T + np.diag(R))
    z = [surprise(P, S @ draw.normal(size=M), H, R) for _ in range(4000)]
    assert np.mean(z) == pytest.approx(1.0, abs=0.05)


def test_the_parameters_follow_the_recursion_of_their_docstring(draw) -> None:
    q, P_0, m_0 = 1e-3, np.diag([1.0, 4.0]), np.array([0.5, -0.25])
    learner = ParameterFilter(["one", "two"], m_0.tolist(), [1.0, 2.0], [-2.0, -2.0], [1.5, 2.0])
    m, P, usual, row, opened = m_0, P_0, 1.0, 0, 0
    for k in range(60):
        phi, R = draw.normal(size=(M, 2)), np.array([0.01, 0.02, 0.01])
        true = np.array([0.7, -0.4]) if k < 40 else np.array([1.4, 1.1])
        r = phi @ (true - m) + 0.1 * draw.normal(size=M) + 3.0 * (k == 20)
        report = learner.update(*map(torch.from_numpy, (r, phi, R)))
        P, mean = (1 - q) * P + q * P_0, m_0 + np.sqrt(1 - q) * (m - m_0)
        S = phi @ P @ phi.T
        z = r @ np.linalg.solve(S + np.diag(R), r) / M
        most = 3 * max(1.0, usual)
        usual, row = usual + 0.05 * (min(z, most) - usual), row + 1 if z > most else 0
        if row == 2:
            P, S, row, opened = P_0, phi @ P_0 @ phi.T, 0, opened + 1
        R = R / min(1.0, most / z)
        K = np.linalg.solve(S + np.diag(R), phi @ P).T
        m = np.clip(mean + K @ (r + phi @ (m - mean)), [-2.0, -2.0], [1.5, 2.0])
        left = np.eye(2) - K @ phi
        P = left @ P @ left.T + (K * R) @ K.T
        assert report.opened == (row == 0 and z > most)
        np.testing.assert_allclose(learner.mean, m, rtol=1e-12)
        np.testing.assert_allclose(learner.covariance, P, rtol=1e-12, atol=1e-15)
    assert opened == 1


def test_forces_are_learned_by_least_squares_with_directional_forgetting(draw) -> None:
    n_pads, n_a = 2, 3
    learner = ForceSensitivity(n_pads, n_a)
    n, s2 = 2 + n_a, np.full(n_pads, 0.3**2)
    theta, D, eye = np.zeros((n_pads, n)), np.zeros((n_pads, n, n)), np.eye(n)
    for k in range(80):
        w, S = 0.1 * draw.normal(size=n_a), 10 * draw.normal(size=(n_pads, n_a))
        way = 0.1 * draw.uniform()
        change = 0.6 * S @ w - 8.0 * way + 0.3 * draw.normal(size=n_pads) - 20.0 * (k == 50)
        change[1] = np.nan if k % 4 == 0 else change[1]
        learner.update(*map(torch.from_numpy, (w, change, S @ w)), way)
        for pad in np.flatnonzero(~np.isnan(change)):
            u = np.concatenate([[S[pad] @ w, 10 * way], 20 * w])
            r = change[pad] - S[pad] @ w - u @ theta[pad]
            doubt = u @ np.linalg.solve(D[pad] / s2[pad] + eye, u)
            r = np.clip(r, -4 * np.sqrt(s2[pad] + doubt), 4 * np.sqrt(s2[pad] + doubt))
            Du = D[pad] @ u
            D[pad] += np.outer(u, u) - 0.03 * np.outer(Du, Du) / max(u @ Du, np.finfo(float).tiny)
            theta[pad] += np.linalg.solve(D[pad] / s2[pad] + eye, u) * r / s2[pad]
            theta[pad] = np.clip(theta[pad], -5, 5)
            s2[pad] += 0.1 * (np.clip(r**2 - doubt, 0.15**2, 400) - s2[pad])
        np.testing.assert_allclose(learner.theta, theta, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(learner.evidence, D, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(learner.variance, s2, rtol=1e-12)


def test_health_is_learned_by_recursive_least_squares(draw) -> None:
    watch = _Watch("servo")
    theta, P = watch.theta, watch.P
    for _ in range(30):
        x, y = np.array([1.0, draw.choice([-1.0, 1.0])]), 0.01 * draw.normal()
        watch.learn(x, y)
        Px = P @ x
        theta, P = theta + Px * (y - theta @ x) / (1 + x @ Px), P - np.outer(Px, Px) / (1 + x @ Px)
        np.testing.assert_allclose(watch.theta, theta, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(watch.P, P, rtol=1e-11, atol=1e-12)
