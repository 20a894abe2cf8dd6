"""Laws of y: cumulative, quantiles, intervals."""

from __future__ import annotations

import pytest
import torch

from torch_ekm.exceptions import ParameterError
from torch_ekm.residual import (
    RandomFeatureRLS,
    ReplayMLP,
    ResidualLearner,
    SparseOnlineGP,
    ZeroResidual,
    default_learner,
)

KINDS = [ZeroResidual, RandomFeatureRLS, ReplayMLP, SparseOnlineGP, default_learner]


def learned(make, n: int = 60) -> tuple[ResidualLearner, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    x = torch.randn(n, 2, generator=g, dtype=torch.float64)
    y = torch.sin(x) + 0.3 * torch.randn(n, 2, generator=g, dtype=torch.float64)
    learner = make(2, 2)
    learner.update(x, y)
    return learner, x


@pytest.mark.parametrize("make", KINDS)
def test_cumulative_density_and_quantile_belong_together(make):
    learner, x = learned(make)
    law = learner.predictive(x[:3])
    low, high = learner.quantile(x[:3], 0.003), learner.quantile(x[:3], 0.8)
    torch.testing.assert_close(law.cdf(low), torch.full_like(low, 0.003), rtol=1e-9, atol=0.0)
    torch.testing.assert_close(law.cdf(high), torch.full_like(high, 0.8), rtol=1e-12, atol=0.0)
    steps = torch.linspace(0.0, 1.0, 4001, dtype=torch.float64)[:, None, None]
    y = low + steps * (high - low)
    mass = torch.trapezoid(law.log_prob(y).exp(), y, dim=0)
    torch.testing.assert_close(mass, torch.full_like(mass, 0.797), rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("make", KINDS)
def test_an_interval_is_of_equal_tails_and_of_the_queries_shape(make):
    learner, x = learned(make)
    low, high = learner.interval(x[:4], 0.6)
    assert low.shape == high.shape == (4, 2)
    torch.testing.assert_close(0.5 * (low + high), learner(x[:4]))
    law = learner.predictive(x[:4])
    torch.testing.assert_close(law.cdf(high) - law.cdf(low), torch.full_like(low, 0.6))
    one = learner.interval(x[0], 0.6)
    torch.testing.assert_close(one, (low[0], high[0]))


def test_a_fleet_has_an_interval_for_each_model():
    fleet = default_learner(2, 1, batch_shape=(3,))
    x = torch.randn(20, 3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    fleet.update(x, x[..., :1] * torch.tensor([[1.0], [10.0], [100.0]], dtype=torch.float64))
    low, high = fleet.interval(x[0])
    width = (high - low).squeeze(-1)
    assert low.shape == (3, 1)
    assert width[0] < width[1] < width[2]


@pytest.mark.parametrize("level", [0.0, 1.0, -0.1, float("nan")])
def test_a_level_that_is_none_is_refused(level):
    learner = ZeroResidual(2, 1)
    with pytest.raises(ParameterError, match=r"in \(0, 1"):
        learner.interval(torch.zeros(2), level)
    with pytest.raises(ParameterError, match=r"in \(0, 1"):
        learner.quantile(torch.zeros(2), level)
