"""Adapters of the libraries that learners are compared with."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("capymoa_regressor", reason="the benchmarks are not part of this installation")

from capymoa_regressor import CapyMOARegressor

from torch_ekm.residual import LearnHyperparameters, SparseOnlineGP, Standardize


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


def test_gpytorch_learns(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gpytorch")
    import gpytorch_svgp

    monkeypatch.setattr(gpytorch_svgp, "_RATE", 0.05)
    x = torch.linspace(-1, 1, 60, dtype=torch.float64).repeat(3)[:, None]
    learner = gpytorch_svgp.GPyTorchSVGP(1, 2, inducing=8)
    assert not learner(x).any()
    y = torch.cat([x, -x], dim=1)
    learner.update(x, y)
    assert (learner(x) - y).square().mean() < 0.3 * y.square().mean()
    law = learner.predict(x, observation=True)
    assert law.mean.shape == law.stddev.shape == y.shape
