"""Laws of y: cumulative, quantiles, intervals."""

import pytest
import torch

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


def test_intervals_hold_where_it_is_calm_and_where_it_is_noisy():
    g = torch.Generator().manual_seed(0)
    x = 2.0 * torch.rand(600, 1, generator=g, dtype=torch.float64) - 1.0
    noise = 0.08 + 0.63 * (x + 1.0) / 2.0
    y = torch.sin(3.0 * x) + noise * torch.randn(600, 1, generator=g, dtype=torch.float64)
    learner = default_learner(1, 1)
    held = []
    for x_t, y_t in zip(x, y, strict=True):
        held.append(bool((learner.predictive(x_t).cdf(y_t) - 0.5).abs() < 0.45))
        learner.update(x_t, y_t)
    order = noise[150:, 0].argsort()
    thirds = torch.tensor(held[150:]).double()[order].reshape(3, -1).mean(-1)
    assert bool(((thirds > 0.84) & (thirds < 0.96)).all()), thirds


def test_local_noise_takes_no_part_where_noise_is_the_same_everywhere():
    g = torch.Generator().manual_seed(1)
    x = torch.randn(500, 3, generator=g, dtype=torch.float64)
    learner = default_learner(3, 1)
    learner.update(x, torch.randn(500, 1, generator=g, dtype=torch.float64))
    assert float(learner.noise.log_factor(x).abs().mean()) < 0.05


@pytest.mark.parametrize("observation", [False, True])
@pytest.mark.parametrize("make", KINDS)
def test_each_query_of_a_draw_has_the_predicted_law(make, observation):
    learner, x = learned(make)
    drawn = learner.sample(x[:2], 4000, observation=observation, generator=torch.Generator().manual_seed(0))
    assert drawn.shape == (4000, 2, 2)
    law = learner.predictive(x[:2]) if observation else learner.predict(x[:2])
    rank = law.cdf(drawn)
    for p in (0.1, 0.5, 0.9):
        assert bool(((rank < p).double().mean(0) - p).abs().max() < 0.03)


@pytest.mark.parametrize("fleet", [(), (2,)])
@pytest.mark.parametrize("make", [RandomFeatureRLS, SparseOnlineGP, default_learner])
def test_a_draw_is_one_function_of_all_queries(make, fleet):
    learner, x = make(2, 2, batch_shape=fleet), learned(ZeroResidual)[1]
    for x_t, y_t in zip(x, torch.sin(x), strict=True):
        learner.update(x_t.expand(*fleet, 2), y_t.expand(*fleet, 2))
    queries = torch.stack([x[0], x[0] + 1e-3, x[0] + 30.0]).reshape(3, *(1 for _ in fleet), 2)
    drawn = learner.sample(queries, 500, generator=torch.Generator().manual_seed(0))
    near, far = drawn[:, 0] - drawn[:, 1], drawn[:, 0] - drawn[:, 2]
    assert drawn.shape == (500, 3, *fleet, 2)
    assert bool((near.std(0) < 0.1 * drawn[:, 0].std(0)).all())
    assert bool((far.std(0) > 0.5 * drawn[:, 0].std(0)).all())
    again = learner.sample(queries, 500, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(drawn, again, atol=0, rtol=0)
