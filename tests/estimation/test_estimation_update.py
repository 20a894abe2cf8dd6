"""The update that all estimates share, the recursions that the estimators state, and what they refuse."""

import math

import numpy as np
import pytest
import torch

from torch_ekm.enhanced import AdaptiveModel, EnhancedModel
from torch_ekm.estimation.filters import ForceSensitivity, ParameterFilter, surprise, update
from torch_ekm.exceptions import (
    NoDerivativeError,
    NonFiniteError,
    ParameterError,
    ShapeError,
    StateMismatchError,
)
from torch_ekm.residual import RecursiveLeastSquares

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
    learner = ParameterFilter(["one", "two"], m_0.tolist(), [1.0, 2.0], [-2.0, -2.0], [1.3, 2.0])
    m, P, usual, row, opened, at_bound = m_0, P_0, 1.0, 0, [], 0
    for k in range(60):
        phi, R = draw.normal(size=(M, 2)), np.array([0.01, 0.02, 0.01])
        true = np.array([0.7, -0.4]) if k < 40 else np.array([1.4, 1.1])
        r = phi @ (true - m) + 0.1 * draw.normal(size=M) + 3.0 * (k == 20)
        found = learner.update(*map(torch.from_numpy, (r, phi, R)))
        P, mean = (1 - q) * P + q * P_0, m_0 + np.sqrt(1 - q) * (m - m_0)
        S = phi @ P @ phi.T
        z = r @ np.linalg.solve(S + np.diag(R), r) / M
        most = 3 * max(1.0, usual)
        usual, row = usual + 0.05 * (min(z, most) - usual), row + 1 if z > most else 0
        if row == 2:
            P, S, row, opened = P_0, phi @ P_0 @ phi.T, 0, [*opened, k]
        weight = min(1.0, most / z)
        R = R / weight
        K = np.linalg.solve(S + np.diag(R), phi @ P).T
        wanted = mean + K @ (r + phi @ (m - mean))
        m = np.clip(wanted, [-2.0, -2.0], [1.3, 2.0])
        left = np.eye(2) - K @ phi
        P = left @ P @ left.T + (K * R) @ K.T
        np.testing.assert_allclose([found, learner.usual], [z, usual], rtol=1e-9)
        at_bound += int((wanted != m).sum())
        np.testing.assert_allclose(learner.mean, m, rtol=1e-12)
        np.testing.assert_allclose(learner.covariance, P, rtol=1e-12, atol=1e-15)
    assert opened == [41]  # the outlier at 20 was none
    assert at_bound > 3


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


NAN = math.nan


def moves(n: int, n_a: int = 3, seed: int = 0) -> torch.Tensor:
    """Motions of 0.1 rad."""
    return 0.1 * torch.randn(n, n_a, dtype=F64, generator=torch.Generator().manual_seed(seed))


def test_it_scales_what_a_stiffer_description_says_everywhere() -> None:
    """S changes from state to state, and the hand presses .4 as hard as it says."""
    learner, draw = ForceSensitivity(1, 3), torch.Generator().manual_seed(2)
    for w in moves(40):
        S = 20 * torch.randn(1, 3, dtype=F64, generator=draw)
        learner.update(w, 0.4 * S @ w, S @ w, 0.0)
    S = torch.tensor([[10.0, -20.0, 5.0]], dtype=F64)
    assert float(learner.scale) == pytest.approx(0.4, abs=0.03)
    torch.testing.assert_close(learner.corrected(S, [0]), 0.4 * S, atol=1.0, rtol=0)


def test_bad_input_changes_nothing_and_the_state_dict_carries_all(unchecked) -> None:
    learner, nothing = ForceSensitivity(2, 3), torch.zeros(2, dtype=F64)
    for w in moves(5):
        learner.update(w, 5.0 * w.sum().expand(2), nothing, 0.0)
    kept = {name: value.clone() for name, value in learner.state_dict().items()}
    with pytest.raises(ShapeError, match="change"):
        learner.update(moves(1)[0], torch.zeros(3, dtype=F64), nothing, 0.0)
    with pytest.raises(NonFiniteError, match="moved"):
        learner.update(torch.full((3,), NAN, dtype=F64), torch.zeros(2, dtype=F64), nothing, 0.0)
    with pytest.raises(NonFiniteError, match="way"):
        learner.update(moves(1)[0], nothing, nothing, NAN)
    learner.update(torch.zeros(3, dtype=F64), nothing, nothing, 0.0)  # nothing moved
    assert all(torch.equal(value, kept[name]) for name, value in learner.state_dict().items())
    other = ForceSensitivity(2, 3)
    of_a_file = {**kept, "variance": torch.full((2,), 0.25**2, dtype=F64)}  # of a smaller noise
    assert not other.state_problems(of_a_file)
    other.load_state_dict(kept)
    for each in (learner, other):
        each.update(moves(1, seed=9)[0], torch.ones(2, dtype=F64), nothing, 0.1)
    assert torch.equal(other.correction, learner.correction)


def test_what_is_lost_as_the_object_turns_either_way_is_no_answer_to_the_actuators() -> None:
    """6 N a radian, of turns to and fro whose answers cancel."""
    true, learner = torch.tensor([[5.0, -3.0, 2.0]], dtype=F64), ForceSensitivity(1, 3)
    for k, one in enumerate(moves(60)):
        way = 0.05 + 0.2 * (k % 3)
        learner.update(one, true @ one - 6.0 * way, torch.zeros(1, dtype=F64), way)
    assert float(learner.by_way) == pytest.approx(-6.0, abs=0.3)
    torch.testing.assert_close(learner.correction, true, atol=0.5, rtol=0)
    still, w = torch.zeros(1, dtype=F64), torch.zeros(3, dtype=F64)
    assert float(learner.spread(w, still, 0.0)) == pytest.approx(float(learner.variance.sqrt()))
    assert float(ForceSensitivity(1, 3).spread(w, still, 0.5)) == pytest.approx(math.hypot(0.3, 0.3 * 5.0))


def test_bad_input_is_refused_bit_for_bit(unchecked) -> None:
    learner = ParameterFilter(["one", "two"], [0.0, 0.0], [1.0, 1.0])
    phi, R = torch.ones(3, 2, dtype=F64), torch.ones(3, dtype=F64)
    learner.update(R, phi, R)
    kept = {name: value.clone() for name, value in learner.state_dict().items()}
    with pytest.raises(NonFiniteError, match="residual"):
        learner.update(torch.tensor([0.0, math.nan, 0.0], dtype=F64), phi, R)
    with pytest.raises(ShapeError, match="derivative"):
        learner.update(torch.zeros(3, dtype=F64), phi[:2], R)
    with pytest.raises(ParameterError, match="noise"):
        learner.update(torch.zeros(3, dtype=F64), phi, 0 * R)
    assert all(torch.equal(value, kept[name]) for name, value in learner.state_dict().items())


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"prior": [1.0, -1.0, 2.0]}, "prior"),
        ({"prior": torch.tensor([[1.0, 2.0], [2.0, 1.0]])}, "prior"),
        ({"prior": torch.tensor([[1.0, 5.0], [0.0, 1.0]])}, "prior"),
        ({"start": [0.0]}, "start"),
        ({"lower": [1.0, -1.0]}, "start"),
        ({"upper": [math.nan, 1.0]}, "upper"),
    ],
)
def test_impossible_filters_are_refused(options, word, unchecked) -> None:
    with pytest.raises(ParameterError, match=word):
        ParameterFilter(["one", "two"], **{"start": [0.0, 0.0], "prior": [1.0, 1.0], **options})


def test_a_damaged_state_is_refused() -> None:
    from torch_ekm._recorded import check_state

    learner = ParameterFilter(["one", "two"], [0.0, 0.0], [1.0, 1.0])
    state = {**learner.state_dict(), "covariance": torch.tensor([[1.0, 2.0], [2.0, 1.0]], dtype=F64)}
    with pytest.raises(StateMismatchError, match="no covariance"):
        check_state(learner, state)


def pendulum(state, action, theta):
    """Increments of angle and speed of a pendulum with unknown gravity and gain, no hand at all."""
    angle, speed = state[..., 0], state[..., 1]
    return torch.stack(
        [0.05 * speed, 0.05 * (theta[1] * action[..., 0] - theta[0] * torch.sin(angle))], dim=-1
    )


def test_any_model_with_parameters_adapts_in_an_enhanced_model() -> None:
    theta = ParameterFilter(["gravity", "gain"], [7.0, 1.0], [3.0, 0.5])
    model = EnhancedModel(AdaptiveModel(pendulum, theta, 0.01), RecursiveLeastSquares(3, 2))
    true, draw = torch.tensor([9.81, 1.4], dtype=F64), torch.Generator().manual_seed(0)
    for _ in range(60):
        state = torch.randn(2, dtype=F64, generator=draw)
        action = 5 * torch.randn(1, dtype=F64, generator=draw)
        ds = pendulum(state, action, true) + 0.005 * torch.randn(2, dtype=F64, generator=draw)
        model.update(state, action, ds)
    torch.testing.assert_close(theta.mean, true, atol=0.3, rtol=0)
    assert not theta.mean.requires_grad
    state, action = torch.tensor([0.5, 0.0], dtype=F64), torch.tensor([1.0], dtype=F64)
    nominal = model.nominal(state, action)
    torch.testing.assert_close(nominal, pendulum(state, action, theta.mean))
    _, J = model.linearize(state, action)
    assert float(J[1, 0]) == pytest.approx(0.05 * 1.4, rel=0.1)


@pytest.mark.parametrize(("width", "unused"), [(3, math.nan), (3, 1e200), (4, 0.0)])
def test_what_the_learner_refuses_does_not_move_theta(width: int, unused: float) -> None:
    theta = ParameterFilter(["gain"], [1.0], [0.5])
    ekm = EnhancedModel(
        AdaptiveModel(lambda s, a, theta: theta * a * s[:1], theta, 0.01), RecursiveLeastSquares(width, 1)
    )
    before = {name: value.clone() for name, value in ekm.named_buffers()}
    state, action = torch.tensor([0.5, unused], dtype=F64), torch.ones(1, dtype=F64)
    with pytest.raises((NonFiniteError, ShapeError)):
        ekm.update(state, action, 2.0 * action)
    for name, value in ekm.named_buffers():
        assert torch.equal(value, before[name]), name


def test_a_model_without_derivative_by_theta_is_refused() -> None:
    theta = ParameterFilter(["gain"], [1.0], [0.5])
    f = AdaptiveModel(lambda s, a, theta: a * float(theta), theta, 0.01)
    with pytest.raises(NoDerivativeError):
        f.adapt(torch.zeros(1), torch.ones(1), torch.ones(1))
    with pytest.raises(ParameterError, match="noise_std"):
        AdaptiveModel(pendulum, theta, 0.0)


def test_a_noise_of_another_width_is_named() -> None:
    theta = ParameterFilter(["one", "two"], [0.0, 0.0], [1.0, 1.0])
    model = AdaptiveModel(lambda s, a, theta: theta * a, theta, noise_std=[0.1, 0.1, 0.1])
    with pytest.raises(ShapeError, match="noise_std"):
        model.adapt(torch.zeros(1), torch.ones(2, dtype=F64), torch.ones(2, dtype=F64))
