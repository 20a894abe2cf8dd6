"""Metrics and statistics against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torch_ekm.exceptions import NonFiniteError, ParameterError, ShapeError
from torch_ekm.experiments.reporting.metrics import (
    bootstrap_mean,
    compare_errors,
    learning_curve,
    prediction_error,
    root_mean_square,
)


def test_prediction_error_picks_the_focused_rows_of_the_object() -> None:
    increment, predicted = torch.arange(26.0), torch.zeros(26)
    focus = torch.zeros(1, 6)
    focus[0, 3] = 1.0
    assert prediction_error(increment, predicted, focus).tolist() == [23.0]


def test_comparison_finds_a_known_difference() -> None:
    rng = np.random.default_rng(0)
    theirs = rng.normal(2.0, 0.5, 200)
    result = compare_errors(theirs - 1.0 + rng.normal(0, 0.1, 200), theirs)
    assert result.low < -1.0 < result.high
    assert result.high - result.low < 0.05  # +- 1.96 * 0.1 / sqrt(200)
    assert result.paired_p < result.welch_p < 1e-10
    assert result.effect_size == pytest.approx(-10, rel=0.2)


def test_comparison_of_equal_samples_is_not_significant() -> None:
    values = np.array([0.5, 1.0, 2.0])
    assert compare_errors(values, values).paired_p == 1.0


def test_p_values_are_uniform_under_the_null() -> None:
    rng = np.random.default_rng(1)
    p = [compare_errors(rng.normal(size=20), rng.normal(size=20)).welch_p for _ in range(400)]
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.08


def test_learning_curve_marks_the_last_negative_result() -> None:
    rng = np.random.default_rng(2)
    theirs = 2 + 0.3 * rng.normal(size=45)
    ours = theirs.copy()
    ours[8:] = 0.5 + 0.1 * rng.normal(size=37)  # learned after eight trials
    curve = learning_curve(ours, theirs)
    assert 8 <= curve.last_negative <= 12
    assert curve.last_upper < -0.5
    assert np.isnan(curve.p[0])
    never = learning_curve(theirs + 0.5, theirs)
    assert never.last_negative == 45
    assert never.last_upper > 0


def test_bootstrap_interval_covers_the_mean() -> None:
    rng = np.random.default_rng(3)
    hits = 0
    for _ in range(100):
        estimate = bootstrap_mean(rng.exponential(1.0, 30), resamples=300)
        hits += estimate.low <= 1.0 <= estimate.high
    assert 84 <= hits <= 99  # percentile intervals of a skewed sample cover a little less than 95
    one = bootstrap_mean(np.array([2.0]))
    assert (one.mean, one.low, one.high) == (2.0, 2.0, 2.0)


def test_bad_samples_are_refused() -> None:
    with pytest.raises(NonFiniteError):
        bootstrap_mean(np.array([1.0, np.nan]))
    with pytest.raises(ShapeError):
        compare_errors(np.ones(3), np.ones(4))
    with pytest.raises(ParameterError):
        root_mean_square(np.array([]))
