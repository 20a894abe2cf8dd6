"""Parameters of a model by a Kalman filter."""

from __future__ import annotations

import math

import pytest
import torch

from torch_ekm.enhanced import AdaptiveModel, EnhancedModel, ParameterFilter
from torch_ekm.exceptions import (
    NoDerivativeError,
    NonFiniteError,
    ParameterError,
    ShapeError,
    StateMismatchError,
)
from torch_ekm.residual import RecursiveLeastSquares

F64 = torch.float64
TRUE = torch.tensor([0.7, -0.4], dtype=F64)


def made(**options) -> ParameterFilter:
    return ParameterFilter(["one", "two"], [0.0, 0.0], [1.0, 1.0], **options)


def motions(n: int, true=TRUE, noise: float = 0.05, seed: int = 0):
    """phi and r of ``y = phi theta``, three rows each."""
    draw = torch.Generator().manual_seed(seed)
    for _ in range(n):
        phi = torch.randn(3, 2, dtype=F64, generator=draw)
        yield phi, phi @ true + noise * torch.randn(3, dtype=F64, generator=draw)


def teach(learner: ParameterFilter, stream, noise: float = 0.05):
    R = torch.full((3,), noise**2, dtype=F64)
    return [learner.update(y - phi @ learner.mean, phi, R) for phi, y in stream]


def test_one_outlier_moves_little_and_two_are_a_change() -> None:
    learner = made()
    teach(learner, motions(30))
    before = learner.mean.clone()
    phi, y = next(iter(motions(1, seed=5)))
    (report,) = teach(learner, [(phi, y + 5.0)])
    assert report.surprise > 3
    assert report.weight < 0.01
    assert not report.opened
    assert float((learner.mean - before).abs().max()) < 0.05
    teach(learner, motions(3, seed=6))  # it was none
    assert int(learner.changed_at) == -1
    new = torch.tensor([1.5, -0.4], dtype=F64)
    reports = teach(learner, motions(4, new, seed=7))
    assert [report.opened for report in reports] == [False, True, False, False]
    assert int(learner.changed_at) == 35
    torch.testing.assert_close(learner.mean, new, atol=0.15, rtol=0)
    torch.testing.assert_close(learner.before, TRUE, atol=0.2, rtol=0)


def test_what_motions_do_not_tell_keeps_its_prior() -> None:
    learner = made()
    one = torch.tensor([1.0, 0.0], dtype=F64)
    teach(learner, ((phi * one, phi @ (TRUE * one)) for phi, _ in motions(200)))
    assert float(learner.mean[1]) == 0.0
    assert float(learner.stddev[1]) == pytest.approx(1.0)
    assert float(learner.stddev[0]) < 0.1
    for _ in range(3000):  # and returns to it where motions say nothing any more
        learner.update(torch.zeros(3, dtype=F64), torch.zeros(3, 2, dtype=F64), torch.ones(3, dtype=F64))
    assert abs(float(learner.mean[0])) < 0.3 * float(TRUE[0])
    assert float(learner.stddev[0]) > 0.9


def test_bounds_hold_and_are_named() -> None:
    learner = made(lower=[-1.0, -1.0], upper=[0.5, 1.0])
    reports = teach(learner, motions(20))
    assert float(learner.mean[0]) == 0.5
    assert "one" in reports[-1].bounded or "one" in reports[-2].bounded


def test_bad_input_is_refused_bit_for_bit(unchecked) -> None:
    learner = made()
    teach(learner, motions(5))
    kept = {name: value.clone() for name, value in learner.state_dict().items()}
    phi, R = torch.ones(3, 2, dtype=F64), torch.ones(3, dtype=F64)
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

    learner = made()
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
    model = AdaptiveModel(lambda s, a, theta: theta * a, made(), noise_std=[0.1, 0.1, 0.1])
    with pytest.raises(ShapeError, match="noise_std"):
        model.adapt(torch.zeros(1), torch.ones(2, dtype=F64), torch.ones(2, dtype=F64))
