"""What a working robot needs of the learner: it never breaks, adapts, forgets, distrusts, recovers."""

import copy
import math

import numpy as np
import pytest
import torch
from as_published import sogp

from torch_ekm.exceptions import EKMError, NonFiniteError
from torch_ekm.experiments.learner_comparison.prequential import run_prequential
from torch_ekm.residual import (
    CalibrateNoise,
    DetectChanges,
    ForgettingFactor,
    ProcessNoise,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ReplayMLP,
    RobustWeight,
    SquaredExponential,
)
from torch_ekm.residual.sparse_gp.engine import recursion

AS_GIVEN = {"standardize": False}  # the equations are those in x and y themselves


def smooth(n: int, rate: float = 100.0) -> tuple[torch.Tensor, torch.Tensor]:
    """A trajectory sampled at ``rate`` [Hz] that stands still at times, so samples repeat exactly."""
    t = torch.arange(n, dtype=torch.float64) / rate
    t = torch.where((t % 10) < 1, t - t % 10, t)
    x = torch.stack(
        [torch.sin(0.3 * t), torch.sin(0.41 * t + 1), torch.cos(0.17 * t), torch.sin(0.07 * t)], -1
    )
    y = torch.stack([torch.sin(2 * x[:, 0] + x[:, 1]), x[:, 2] * x[:, 3]], -1)
    return x, y


def system(seed: int, n: int, which: int = 0, noise: float = 0.1) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    w = np.random.default_rng(50 + which).normal(size=(4, 2)) * 0.7
    x = rng.normal(size=(n, 4))
    return torch.from_numpy(x), torch.from_numpy(np.sin(x @ w) + noise * rng.normal(size=(n, 2)))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_smooth_trajectory_never_breaks(dtype):
    """The textbook recursion is NaN here within 1e4 samples; the long run is in the benchmarks."""
    x, y = smooth(3000 if dtype == torch.float64 else 1500)  # without compiled loops it takes long
    kernel = SquaredExponential(4, lengthscale=1.0)
    gp = sogp(4, 2, capacity=40, kernel=kernel, noise_variance=1e-4, dtype=dtype)
    gp.update(x[:-9].to(dtype), y[:-9].to(dtype))
    gp.update(x[-9:].to(dtype), y[-9:].to(dtype))
    rebuilt = copy.deepcopy(gp)
    rebuilt.refresh()
    query = x[::50].to(dtype)
    mean, variance = gp(query), gp.predict(query).variance
    assert bool(mean.isfinite().all())
    assert float(variance.min()) > 0
    assert float((mean - y[::50].to(dtype)).abs().max()) < 0.2
    assert float((mean - rebuilt(query)).abs().max()) < 1e-6 + (dtype == torch.float32) * 1e-5
    assert float((variance - rebuilt.predict(query).variance).abs().max()) < 1e-6


def test_a_thousand_times_the_same_sample():
    gp = sogp(3, 1, capacity=5, noise_variance=0.01)
    x, y = torch.ones(3, dtype=torch.float64), torch.tensor([2.0], dtype=torch.float64)
    gp.update(x.expand(1000, 3), y.expand(1000, 1))
    assert int(gp.posterior.count) == 1
    assert float(gp(x)) == pytest.approx(2.0, abs=1e-3)
    assert 0 < float(gp.predict(x).variance) < 2e-5


def test_branch_free_path_gives_the_same(monkeypatch):
    """On a GPU and in a compiled graph no branch looks at data: the same numbers must come out."""
    x, y = system(1, 80)
    x = torch.stack([x, x.flip(0), x * 0.1], 1)
    y = torch.stack([y, y.flip(0), y], 1)
    mask = torch.rand(80, 3, generator=torch.Generator().manual_seed(0)) < 0.7
    mask[:20, 2] = False  # a model that stays empty for long
    gps = [sogp(4, 2, capacity=10, batch_shape=(3,), parts=[RobustWeight(3.0)]) for _ in range(2)]
    gps[0].update(x, y, mask)
    monkeypatch.setattr(recursion, "_any", lambda flag: True)
    gps[1].update(x, y, mask)
    torch.testing.assert_close(gps[0](x), gps[1](x), atol=1e-11, rtol=0)
    torch.testing.assert_close(
        gps[0].predict(x[:5]).variance, gps[1].predict(x[:5]).variance, atol=1e-11, rtol=0
    )


def test_calibration_covers_whatever_the_noise():
    x, y = system(6, 900, noise=0.0)
    rng = np.random.default_rng(0)
    y = y + 0.1 * torch.from_numpy(rng.standard_t(2, size=y.shape))  # infinite variance
    y[:, 1] *= 5.0
    covered = []
    for calibrate in (False, True):
        parts = [RobustWeight(2.0), CalibrateNoise()][: 1 + calibrate]
        gp = sogp(4, 2, capacity=40, noise_variance=0.01, parts=parts)
        covered.append(run_prequential(gp, x, y).coverage(200))
    assert float((covered[0] - 0.9).abs().max()) > 0.1
    assert float((covered[1] - 0.9).abs().max()) < 0.03


def test_change_is_noticed_and_outliers_are_not():
    """After 50 samples of the new system no worse than a learner that knows nothing else, in each case."""

    def make(detect=True):
        return sogp(4, 2, capacity=60, parts=[RobustWeight(2.0), DetectChanges()][: 1 + detect])

    def ratio(seed, which, detect):
        after = system(seed + 10, 60, which)
        test = system(seed + 20, 200, which)
        return recovery_after_change(lambda: make(detect), system(seed, 300, 0), after, test)

    # systems 3 and 4 contradict the old one slowly: samples from before the alarm must count too
    assert max(ratio(seed, which, True) for seed in range(2) for which in range(1, 5)) < 1.10
    assert ratio(0, 1, False) > 1.5


def rms(learner, test) -> float:
    return float((learner(test[0]) - test[1]).square().mean().sqrt())


def outlier_cost(factory, train, test) -> float:
    """Error with a tenth of the targets thrown off by 20 deviations, over that without."""
    generator = torch.Generator().manual_seed(0)
    x, y = train
    hit = torch.rand(len(y), 1, generator=generator) < 0.1
    sign = torch.randn(y.shape, generator=generator, dtype=y.dtype).sign()
    clean, dirty = factory(), factory()
    clean.update(x, y)
    dirty.update(x, y + hit * 20.0 * sign)
    return rms(dirty, test) / rms(clean, test)


def recovery_after_change(factory, before, after, test) -> float:
    """Error over that of a fresh learner, both after the same 50 samples of the new system."""
    old, fresh = factory(), factory()
    old.update(*before)
    for learner in (old, fresh):
        learner.update(after[0][:50], after[1][:50])
    return rms(old, test) / rms(fresh, test)


def test_gross_outliers_cost_at_most_a_tenth_whatever_other_part_there_is():
    x, y = system(7, 600)
    test = system(8, 300)
    for others in ([], [ProcessNoise(0.003)], [DetectChanges()]):
        parts = [RobustWeight(3.0), *others]
        assert outlier_cost(lambda parts=parts: sogp(4, 2, capacity=60, parts=parts), (x, y), test) < 1.10
    assert outlier_cost(lambda: sogp(4, 2, capacity=60), (x, y), test) > 2.0


def test_forgetting_follows_a_drift():
    x, y = system(9, 800)
    angle = torch.linspace(0, math.pi, 800, dtype=torch.float64)[:, None]
    y = torch.cos(angle) * y
    errors = []
    for parts in ([], [ForgettingFactor(0.98)]):
        gp = sogp(4, 2, capacity=60, parts=parts)
        errors.append(float(run_prequential(gp, x, y).error[400:].square().mean()))
    assert errors[1] < 0.6 * errors[0]


def test_refusal_names_the_place_and_is_an_ekm_error():
    gp = sogp(4, 2)
    x, y = system(14, 5)
    x[3, 2] = math.inf
    with pytest.raises(NonFiniteError, match=r"x must be finite.*\(3, 2\)"):
        gp.update(x, y)
    with pytest.raises(EKMError):
        gp.update(torch.zeros(4), torch.zeros(3))


# -- the field -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "variance"), [(1.0, 2.0), (0.9, 1.0)])
def test_rls_is_weighted_ridge_regression(factor, variance):
    x, y = system(15, 60)
    options = {"noise_variance": 0.2, "weight_variance": variance, "forgetting_factor": factor}
    rls = RecursiveLeastSquares(4, 2, **options, **AS_GIVEN)
    rls.refresh_every = 1
    rls.update(x, y)
    phi, w = np.hstack([x.numpy(), np.ones((60, 1))]), factor ** np.arange(60, 0, -1)
    P = np.linalg.inv((phi.T * w) @ phi / 0.2 + np.eye(5) / variance)
    np.testing.assert_allclose(rls.weights.numpy(), P @ (phi.T * w) @ y.numpy() / 0.2, atol=1e-9)
    np.testing.assert_allclose(rls.covariance.numpy(), P, atol=1e-9)


def test_random_features_approach_the_gp():
    x, y = system(16, 80)
    kernel = SquaredExponential(4)
    gp = sogp(4, 2, capacity=80, kernel=kernel, novelty_threshold=0.0)
    rff = RandomFeatureRLS(4, 2, n_frequencies=300, noise_variance=0.01, **AS_GIVEN)
    gp.update(x, y)
    rff.update(x, y)
    assert float((gp(x) - rff(x)).square().mean().sqrt()) < 0.05


def test_networks_learn_too():
    x, y = system(19, 400)
    learner = ReplayMLP(4, 2)
    learner.update(x, y)
    xs, ys = system(20, 200, noise=0.0)
    assert float((learner(xs) - ys).square().mean()) < 0.3 * float(ys.square().mean())
