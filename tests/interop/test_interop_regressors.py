"""Learners keep river's contract; the benchmark on public records measures what the protocols say."""

import re

import numpy as np
import public_streams
import pytest
import torch
from river import checks, datasets, dummy, evaluate, metrics, stats

from torch_ekm import LearnHyperparameters, SparseOnlineGP, Standardize, ZeroResidual
from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError, StateError
from torch_ekm.interop import OnlineRegressor, as_river
from torch_ekm.interop.online_regressor import make_learner


def small(d: int, m: int) -> SparseOnlineGP:
    return SparseOnlineGP(d, m, capacity=30, parts=[Standardize(), LearnHyperparameters()])


def tiny(d: int, m: int) -> SparseOnlineGP:
    """For the libraries' own checks, which learn thousands of samples and ask for no accuracy."""
    return SparseOnlineGP(d, m, capacity=6, parts=[Standardize()])


def wave(n: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """40 + a sum of sines of three inputs, noise .05."""
    random = np.random.default_rng(seed)
    x = random.uniform(-1.5, 1.5, (n, 3))
    return x, 40.0 + np.sin(2 * x).sum(1) + 0.05 * random.normal(size=n)


def test_river_finds_nothing_wrong() -> None:
    checks.check_estimator(as_river(tiny(6, 1)))


def test_river_finds_nothing_wrong_with_features_that_come_and_go() -> None:
    """With a factory, which is asked for as many inputs as the first sample has features."""
    model = as_river(tiny)
    chosen = [one for one in checks.yield_checks(model) if re.search("features|clone", one.__name__)]
    assert len(chosen) > 2
    for check in chosen:
        check(model.clone())


def test_river_example() -> None:
    model = as_river(SparseOnlineGP(6, 1, parts=[Standardize(), LearnHyperparameters()]))
    error = evaluate.progressive_val_score(datasets.TrumpApproval().take(300), model, metrics.RMSE())
    mean = evaluate.progressive_val_score(
        datasets.TrumpApproval().take(300), dummy.StatisticRegressor(stats.Mean()), metrics.RMSE()
    )
    assert error.get() < 0.5 * mean.get()


def test_features_come_and_go_by_name() -> None:
    one, other = as_river(small(3, 1)), as_river(small(3, 1))
    x, y = wave(60)
    assert one.predict_one({"a": 1.0}) is None
    for row, target in zip(x, y, strict=True):
        named = dict(zip("abc", row, strict=True))
        one.learn_one(named, target)
        other.learn_one(dict(reversed(named.items())), target)
    assert one.predict_one({"c": 0.2, "a": 0.1, "b": 0.0}) == other.predict_one(
        {"a": 0.1, "b": 0.0, "c": 0.2}
    )
    at_the_mean = {"a": 0.3, "b": 0.3, "c": float(x[:, 2].mean())}
    assert one.predict_one({"a": 0.3, "b": 0.3}) == pytest.approx(one.predict_one(at_the_mean), abs=1e-9)
    with pytest.raises(ShapeError, match="a, b, c, d"):
        one.learn_one({"a": 0.0, "d": 1.0}, 0.0)


def test_a_wrong_learner_is_named() -> None:
    with pytest.raises(StateError, match="one model of 3 inputs and 1 outputs"):
        make_learner(small(2, 1), 3, 1)
    regressor = OnlineRegressor(small(3, 1))
    with pytest.raises(ParameterError, match="level"):
        regressor.interval(np.zeros((1, 3)), 95.0)


def test_predictions_are_those_of_the_learner() -> None:
    x, y = wave(50)
    regressor, learner = OnlineRegressor(small(3, 1)), small(3, 1)
    for row, target in zip(x, y, strict=True):
        regressor.learn(row, np.array([target]))
        learner.update(torch.from_numpy(row), torch.from_numpy(np.array([target]) - y[0]))
    law = learner.predict(torch.from_numpy(x), observation=True)
    mean, deviation = regressor.predict(x)
    assert np.allclose(mean, y[0] + law.mean.numpy(), rtol=1e-12)
    assert np.allclose(deviation, law.stddev.numpy(), rtol=1e-9)
    low, high = regressor.interval(x, 0.95)
    assert np.allclose(high - low, 2 * 1.959963984540054 * deviation, rtol=1e-12)


def test_a_refused_sample_of_a_stream_changes_nothing() -> None:
    regressor = as_river(small(2, 1))
    regressor.learn_one({"a": 1.0, "b": 2.0}, 1.0)
    for x in ({"a": np.nan, "b": 2.0}, {"a": np.inf, "b": 2.0}):
        with pytest.raises(NonFiniteError):
            regressor.learn_one(x, 1.0)
    regressor.learn_one({"b": 2.0}, 1.0)  # a is put at its mean, 1
    assert regressor.predict_one({"b": 2.0}) == regressor.predict_one({"a": 1.0, "b": 2.0})


def test_a_first_target_that_is_skipped_is_not_the_offset() -> None:
    regressor = OnlineRegressor(SparseOnlineGP(1, 1, on_invalid="skip"))
    regressor.learn(np.zeros(1), np.array([np.nan]))
    regressor.learn(np.zeros(1), np.array([5.0]))
    assert regressor.predict(np.zeros((1, 1)))[0][0, 0] == pytest.approx(5.0)


def test_progressive_error_from_nothing_and_intervals_over_the_range() -> None:
    random = np.random.default_rng(0)
    x, y = random.random((1200, 2)), 10.0 + random.normal(size=1200)
    first, whole = public_streams.fried("zero", lambda d, m: ZeroResidual(d, m, noise_variance=1.44), x, y)
    error = y - y[0]  # it says the first target ever after
    error[0] = y[0]  # before which it says 0
    assert (first.stream, first.samples) == ("Fried, first 1000", 1000)
    assert (whole.stream, whole.samples) == ("Fried", 1200)
    assert first.rmse == pytest.approx(np.sqrt(np.square(error[:1000]).mean()))
    assert whole.mae == pytest.approx(np.abs(error).mean())
    half = 1.959963984540054 * 1.2
    assert whole.coverage == pytest.approx((np.abs(error[1:]) <= half).sum() / 1200)
    assert whole.width == pytest.approx(2 * half * 1199 / 1200 / np.ptp(y), rel=1e-6)


def test_rivers_track_is_scored_by_river() -> None:
    row = public_streams.track("TrumpApproval", "mean", dummy.StatisticRegressor(stats.Mean()), 50)
    y = np.array([target for _, target in datasets.TrumpApproval().take(50)])
    before = np.concatenate([[0.0], np.cumsum(y)[:-1] / np.arange(1, 50)])
    assert row.rmse == pytest.approx(np.sqrt(np.square(y - before).mean()))
