"""A learner made from its two sizes takes care of units: whatever they are, and however the stream begins."""

import pytest
import torch
from as_published import share_left

from torch_ekm.residual import (
    DeepKernelSOGP,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ReplayMLP,
    SparseOnlineGP,
    Standardize,
    default_learner,
)
from torch_ekm.residual.running_scale import BLOCK, RunningScale

SMALL = {
    "sogp": lambda **o: SparseOnlineGP(3, 2, capacity=30, **o),
    "deep": lambda **o: DeepKernelSOGP(3, 2, capacity=30, hidden=(8,), features=2, **o),
    "default": lambda **o: default_learner(3, 2, capacity=20, **o),
    "rls": lambda **o: RecursiveLeastSquares(3, 2, **o),
    "rff": lambda **o: RandomFeatureRLS(3, 2, n_frequencies=30, **o),
    "mlp": lambda **o: ReplayMLP(3, 2, hidden=(16,), members=2, **o),
}
EVERY = pytest.mark.parametrize("make", SMALL.values(), ids=SMALL)
#: Their g can take the shape of what is learned here: a linear one cannot, and a network is slow.
FLEXIBLE = pytest.mark.parametrize("make", [SMALL[name] for name in ("sogp", "deep", "default", "rff")])


def stream(n: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    y = torch.stack([torch.sin(x[:, 0] + x[:, 1]), 0.5 * x[:, 2]], dim=1)
    return x, y + 0.05 * torch.randn(n, 2, generator=generator, dtype=torch.float64)


def error(learner, x: torch.Tensor, y: torch.Tensor) -> float:
    """rms error of what it predicts, over that of the model alone."""
    return float((learner(x) - y).square().mean().sqrt() / y.square().mean().sqrt())


@EVERY
def test_units_do_not_matter(make):
    x, y = stream(80)
    plain = make()
    plain.update(x, y)
    queries = stream(20, seed=1)[0]
    for unit, origin, unit_y in ((1e-3, 0.0, 1e-3), (180.0, 1e4, 1e3)):
        other = make()
        other.update(x * unit + origin, y * unit_y)
        asked = queries * unit + origin
        torch.testing.assert_close(other(asked) / unit_y, plain(queries), rtol=1e-3, atol=1e-3)
        deviations = other.predict(asked).stddev / unit_y, plain.predict(queries).stddev
        torch.testing.assert_close(*deviations, rtol=1e-3, atol=4e-3)


@FLEXIBLE
def test_a_start_at_rest(make):
    """A log stands still for two seconds and then moves, in metres."""
    t = torch.arange(200, dtype=torch.float64) * 0.04
    moved = (t - 2.0).clamp_min(0.0)
    x = 1e-3 * torch.stack([torch.sin(1.3 * moved), torch.sin(2.1 * moved), moved * 0.0], dim=1)
    y = 1e-4 * torch.stack([torch.sin(3e3 * x[:, 0]), 1e3 * x[:, 0] * x[:, 1] * 1e3], dim=1)
    learner = make()
    learner.update(x[:150], y[:150])
    assert share_left(learner, x[150:], y[150:]) < 0.3


@FLEXIBLE
@pytest.mark.parametrize("place", [0, 3])
def test_a_huge_outlier_among_the_first(make, place):
    x, y = stream(200)
    y[place], x[(place + 1)] = 1e6, 1e5
    learner = make()
    learner.update(x, y)
    assert error(learner, *stream(60, seed=1)) < 0.6


@FLEXIBLE
def test_sorted_and_constant_columns(make):
    x, y = stream(200)
    x[:, 2], y[:, 1] = 7.0, x[:, 1]
    order = x[:, 0].argsort()
    learner = make()
    learner.update(x[order], y[order])
    late = order[-60:]
    assert error(learner, x[late], y[late]) < 0.6


@EVERY
def test_huge_numbers_stay_finite(make):
    x, y = stream(80)
    learner = make()
    learner.update(x * 1e150, y * 1e150)
    law = learner.predict(x[:9] * 1e150)
    assert bool(law.mean.isfinite().all() and law.stddev.isfinite().all())
    assert bool((law.mean != 0).any())


@pytest.mark.parametrize("kind", ["sogp", "deep", "default", "rls", "rff"])
def test_an_offset_of_the_outputs(kind):
    """Far from all samples the prediction is the mean of y, whose size does not matter."""
    x, y = stream(150)
    learned = {"output_offset": "learned"}
    learner = SMALL[kind](**learned if kind == "default" else {"standardize": Standardize(**learned)})
    assert torch.equal(learner(x[:2]), torch.zeros(2, 2, dtype=torch.float64))
    learner.update(x, y + 300.0)
    assert float((learner(x) - y - 300.0).square().mean().sqrt()) < 0.45
    if kind in ("sogp", "krls_t"):
        torch.testing.assert_close(learner(x[0] + 1e3), (y + 300.0).mean(0), rtol=0, atol=0.3)


def test_a_slow_change_of_scale_is_followed():
    n = 3000
    growth = torch.logspace(0, 1, n, dtype=torch.float64).unsqueeze(-1)
    x = stream(n)[0] * growth
    scale = RunningScale(3, [True] * 3)
    scale.memory = 300
    for block in x.split(BLOCK):
        scale.pool(block, torch.ones(len(block)).double())
    scale.settle()
    torch.testing.assert_close(scale.scale, torch.full_like(scale.scale, 8.5), rtol=0.2, atol=0.0)


def test_what_rests_keeps_its_units():
    scale = RunningScale(1, [True])
    scale.memory = 300
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(4000, 1, generator=generator, dtype=torch.float64)
    x[1000:] *= 1e-6
    for block in x.split(BLOCK):
        scale.pool(block, torch.ones(len(block)).double())
    scale.settle()
    assert 0.3 < float(scale.scale) < 1.2


def test_new_units_change_no_prediction():
    """The natural form follows exactly: the same learner in units that were right from the start."""
    x, y = stream(40)
    learner = SparseOnlineGP(3, 2, capacity=50, parts=[Standardize(output_offset="learned")])
    learner.update(x, y + 5.0)
    units = learner.units
    precision = learner.posterior.precision.sum(-1, keepdim=True)
    old = learner.posterior.information * units.output.scale + precision * units.output.shift
    units.output.centre += 2.0
    units.output.spread *= 3.0
    learner.refresh()
    new = learner.posterior.information * units.output.scale + precision * units.output.shift
    assert float(units.output.shift.min()) > 6.0
    torch.testing.assert_close(new, old)  # Omega-weighted targets at the basis, in y's own unit


def test_bursts_are_no_outliers():
    """What comes in company belongs to the stream; as many large samples that come alone do not."""
    generator = torch.Generator().manual_seed(0)
    small = 0.01 * torch.randn(640, 1, generator=generator, dtype=torch.float64)
    large = torch.randn(640, 1, generator=generator, dtype=torch.float64)
    burst = (torch.arange(640) % 64 < 6).unsqueeze(-1)
    alone = burst[torch.randperm(640, generator=generator)]
    found = []
    for on in (burst, alone):
        scale = RunningScale(1)
        for block in torch.where(on, large, small).split(BLOCK):
            scale.pool(block, torch.ones(BLOCK).double())
        scale.settle()
        found.append(float(scale.scale))
    assert found[0] > 0.04
    assert found[1] < 0.03
