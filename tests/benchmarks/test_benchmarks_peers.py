"""Adapters of the libraries that learners are compared with."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("capymoa_regressor", reason="the benchmarks are not part of this installation")

from capymoa_regressor import CapyMOARegressor

from torch_ekm.residual import LearnHyperparameters, SparseOnlineGP, SquaredExponential, Standardize
from torch_ekm.testing import check_residual_learner


def small(d: int, m: int) -> SparseOnlineGP:
    return SparseOnlineGP(d, m, capacity=30, parts=[Standardize(), LearnHyperparameters()])


def wave(n: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """40 + a sum of sines of three inputs, noise .05."""
    random = np.random.default_rng(seed)
    x = random.uniform(-1.5, 1.5, (n, 3))
    return x, 40.0 + np.sin(2 * x).sum(1) + 0.05 * random.normal(size=n)


def test_what_capymoa_asks_of_a_regressor() -> None:
    x, y = wave(200)
    regressor, errors, held = CapyMOARegressor(learner=small), [], []
    for row, target in zip(x, y, strict=True):
        instance = SimpleNamespace(x=row, y_value=target)
        low, mean, high = regressor.predict_interval(instance)
        assert mean == pytest.approx(regressor.predict(instance))
        errors.append(target - mean)
        held.append(low <= target <= high)
        regressor.train(instance)
    assert errors[0] == y[0], "before the first sample it predicts 0"
    assert np.std(errors[100:]) < 0.45 * y.std()
    assert np.mean(held[100:]) > 0.85
    assert str(regressor) == "torch_ekm SparseOnlineGP"


def test_capymoa_example() -> None:
    pytest.importorskip("capymoa", reason="CapyMOA needs Java and is not among the extras")
    from capymoa.evaluation import prequential_evaluation
    from capymoa.stream import NumpyStream

    x, y = wave(300)
    stream = NumpyStream(x, y, dataset_name="wave", target_type="numeric")
    result = prequential_evaluation(stream, CapyMOARegressor(stream.get_schema(), small))
    assert result.cumulative.rmse() < 45.0


def test_gpytorch_learns() -> None:
    pytest.importorskip("gpytorch")
    from gpytorch_svgp import GPyTorchSVGP

    x = torch.linspace(-1, 1, 60, dtype=torch.float64).repeat(3)[:, None]
    learner = GPyTorchSVGP(1, 2, inducing=8, memory=20, minibatch=10)
    assert not learner(x).any()
    y = torch.cat([x, -x], dim=1)
    learner.update(x, y)
    assert (learner(x) - y).square().mean() < 0.3 * y.square().mean()
    law = learner.predict(x, observation=True)
    assert law.mean.shape == law.stddev.shape == y.shape


@pytest.mark.parametrize("name", ["BayesianLastLayer", "LowRankKalman"])
def test_networks_learn(name: str) -> None:
    if name == "BayesianLastLayer":
        pytest.importorskip("vbll")
    import network_peers

    draw = torch.Generator().manual_seed(3)
    x = torch.rand(240, 1, generator=draw, dtype=torch.float64) * 4 - 2
    y = torch.cat([x.sin(), -x], dim=1) + 0.05 * torch.randn(240, 2, generator=draw, dtype=torch.float64)
    learner = getattr(network_peers, name)(1, 2)
    before = learner.predict(x)
    learner.update(x, y)
    law = learner.predict(x, observation=True)
    assert (learner(x) - y).square().mean() < 0.1 * y.square().mean()
    assert ((law.mean - y).abs() < 2.0 * law.stddev).double().mean() > 0.8
    assert (learner.predict(x).variance < before.variance).double().mean() > 0.9
    learner.reset()
    torch.testing.assert_close(learner.predict(x).mean, before.mean, atol=0, rtol=0)


def test_low_rank_kalman_moves_by_its_gain() -> None:
    from network_peers import LowRankKalman

    draw = torch.Generator().manual_seed(5)
    x = torch.rand(40, 2, generator=draw, dtype=torch.float64)
    learner = LowRankKalman(2, 1)
    learner.update(x, x.sum(-1, keepdim=True).sin())
    learner._last_cov *= 1e-3  # the hidden weights decide
    at, y = x[:1] + 0.3, torch.tensor([[1.2]], dtype=torch.float64)
    latent, noisy = learner.predict(at), learner.predict(at, observation=True)
    learner.update(at, y)
    expected = latent.mean + latent.variance / noisy.variance * (y - latent.mean)
    assert (expected - latent.mean).abs() > 5e-3
    torch.testing.assert_close(learner(at) - latent.mean, expected - latent.mean, atol=0, rtol=0.05)


def test_krls_tracker_without_forgetting_is_the_exact_gp() -> None:
    from krls_tracker import KRLSTracker

    draw = torch.Generator().manual_seed(18)
    x, y = (torch.randn(30, n, dtype=torch.float64, generator=draw) for n in (4, 2))
    kernel = SquaredExponential(4)
    tracker = KRLSTracker(4, 2, capacity=40, kernel=kernel, noise_variance=0.05, standardize=False)
    tracker.jitter = 1e-9
    tracker.update(x, y)
    K = kernel(x, x)
    solved = torch.linalg.solve(K + 0.05 * torch.eye(30, dtype=torch.float64), torch.cat([y, K], dim=-1))
    law = tracker.predict(x)
    torch.testing.assert_close(law.mean, K @ solved[:, :2], atol=1e-6, rtol=0)
    variance = (K - K @ solved[:, 2:]).diagonal()[:, None].expand(-1, 2)
    torch.testing.assert_close(law.variance, variance, atol=1e-6, rtol=0)


@pytest.mark.usefixtures("unchecked")
def test_krls_tracker_keeps_the_contract() -> None:
    from krls_tracker import KRLSTracker

    check_residual_learner(
        lambda **options: KRLSTracker(3, 2, capacity=8, forgetting_factor=0.99, **options), n_samples=16
    )
