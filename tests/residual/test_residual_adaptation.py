"""Kernel, noise and features learned online: the loss, its gradients, the memory, and what it all gains."""

import copy
import math

import numpy as np
import pytest
import torch
from as_published import deep_sogp, sogp

from torch_ekm.experiments.learner_comparison.prequential import run_prequential
from torch_ekm.residual import (
    DeepKernel,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    Matern32,
    ProcessNoise,
    RobustWeight,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
)
from torch_ekm.residual.kernels.kernel import Kernel
from torch_ekm.residual.recent import Recent
from torch_ekm.residual.sparse_gp.hyperparameters import Queries


def system(seed: int, n: int, noise: float = 0.1) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    w = np.random.default_rng(50).normal(size=(4, 2)) * 0.7
    x = rng.normal(size=(n, 4))
    return torch.from_numpy(x), torch.from_numpy(np.sin(x @ w) + noise * rng.normal(size=(n, 2)))


def learning_of(gp: SparseOnlineGP) -> LearnHyperparameters:
    part = gp.part(LearnHyperparameters)
    return part


def loss_by_dense_algebra(gp: SparseOnlineGP, queries: Queries, robust: float | None) -> torch.Tensor:
    """The loss as its docstring states it, with inverses, for autograd to go through."""
    log_noise, kernel = gp.log_noise_variance, gp.kernel
    s2 = log_noise.mean(-1).exp()[..., None, None]
    loss = learning_of(gp).loss
    old = loss.state
    K = old.gram(kernel)
    k = kernel(old.basis, queries.x) * old.active.unsqueeze(-1)
    W, h = old.precision / s2, old.information / s2
    eye = torch.eye(K.shape[-1], dtype=K.dtype)
    alpha, C = torch.linalg.solve(eye + W @ K, h), -torch.linalg.solve(eye + W @ K, W)
    u = (k * (torch.linalg.inv(K) @ k)).sum(-2)
    v = kernel.diagonal_of_set(queries.x) + (k * (C @ k)).sum(-2)
    p = u + (k * (C @ k)).sum(-2)
    share = queries.absorbed * queries.weight * loss.forgetting_factor**queries.age * p / s2.squeeze(-1)
    left_out = torch.where(share < 1, torch.minimum(1.0 / (1.0 - share), u / p), u / p)
    variance = (v + p * (left_out - 1.0)).unsqueeze(-1) + log_noise.exp().unsqueeze(-2)
    z2 = ((queries.y - k.mT @ alpha) * left_out.unsqueeze(-1)).square() / variance
    misfit = z2 if robust is None else (robust**2 + 1.0) * torch.log1p(z2 / robust**2)
    density = 0.5 * (misfit + variance.log() + math.log(2 * math.pi)).mean(-1)
    on = queries.weight
    return (density * on).sum(-1) / on.sum(-1)


def of_kind(kind: type[Kernel], fleet: tuple[int, ...]) -> Kernel:
    if kind is not DeepKernel:
        return kind(4, batch_shape=fleet)
    return DeepKernel(SquaredExponential(4, batch_shape=fleet), hidden=(8, 8), features=3)


@pytest.mark.parametrize("fleet", [(), (3,)])
@pytest.mark.parametrize(("robust", "fading"), [(None, []), (3.0, [ForgettingFactor(0.98)])])
@pytest.mark.parametrize("kind", [SquaredExponential, Matern32, DeepKernel])
def test_gradients_are_those_of_dense_algebra(kind, robust, fleet, fading):
    kernel = of_kind(kind, fleet)
    weight = [] if robust is None else [RobustWeight(robust)]
    gp = sogp(
        4, 2, capacity=20, kernel=kernel, noise_variance=0.05, refresh_every=16, batch_shape=fleet,
        parts=[*weight, *fading, Standardize(), LearnHyperparameters(memory=50)],
    )  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(111, *fleet, 4, generator=generator, dtype=torch.float64)
    y = torch.sin(2 * x[..., :2]) + 0.1 * torch.randn(x[..., :2].shape, generator=generator).double()
    gp.update(x, y)  # the last window is full but for one sample, so not used up
    learning = learning_of(gp)
    queries = learning.queries(gp, gp.n_samples)
    assert queries.x.shape[-2] > 16
    parameters = [*gp.kernel.buffers(), gp.log_noise_variance]
    for p in parameters:
        p.requires_grad_(True)
    losses = (
        learning.loss(gp.kernel, gp.log_noise_variance, queries),
        loss_by_dense_algebra(gp, queries, robust),
    )
    ours, dense = (torch.autograd.grad(loss.sum(), parameters) for loss in losses)
    for p in parameters:
        p.requires_grad_(False)
    torch.testing.assert_close(*losses, atol=1e-10, rtol=0)
    for mine, theirs in zip(ours, dense, strict=True):
        assert float(theirs.abs().max()) > 1e-6
        torch.testing.assert_close(mine, theirs, atol=1e-9, rtol=1e-7)


def test_lagged_loss_is_the_density_of_the_old_state():
    x, y = system(4, 64)
    gp = sogp(4, 2, capacity=20, refresh_every=16, parts=[LearnHyperparameters()])
    gp.update(x[:48], y[:48])
    law = gp.predict(x[48:63], observation=True)
    expected = -law.log_prob(y[48:63]).mean(-1).mean()
    gp.update(x[48:63], y[48:63])
    learning = learning_of(gp)
    queries = learning.queries(gp, gp.n_samples)
    loss = learning.loss(gp.kernel, gp.log_noise_variance, queries)
    assert float(loss) == pytest.approx(float(expected), abs=1e-6)


def test_a_replayed_sample_is_predicted_by_the_exact_gp_of_all_others():
    x, y = system(7, 24)
    gp = sogp(4, 2, capacity=24, refresh_every=24, parts=[LearnHyperparameters(memory=24)])
    learning_of(gp).steps = 0  # the kernel stays
    gp.posterior.jitter = learning_of(gp).loss.state.jitter = 1e-10
    gp.update(x, y)
    a = learning_of(gp).loss
    s2 = gp.noise_variance
    K = gp.kernel(x, x) + s2.mean() * torch.eye(24, dtype=torch.float64)
    for i in (0, 11, 23):
        others = [j for j in range(24) if j != i]
        solved = torch.linalg.solve(K[others][:, others], torch.cat([y[others], K[others, i : i + 1]], -1))
        mean, variance = K[i, others] @ solved[:, :2], K[i, i] - K[i, others] @ solved[:, 2]
        expected = -torch.distributions.Normal(mean, variance.sqrt()).log_prob(y[i]).mean()
        one = torch.ones(1, dtype=torch.float64)
        query = Queries(x[i : i + 1], y[i : i + 1], one, one, one)
        loss = a(gp.kernel, gp.log_noise_variance, query)
        assert float(loss) == pytest.approx(float(expected), abs=1e-6)
        seen = a(gp.kernel, gp.log_noise_variance, query._replace(absorbed=0.0 * one))
        assert float(seen) < float(loss) - 1e-3  # what was seen flatters itself


def filled(n: int, capacity: int) -> Recent:
    recent = Recent(1, 1, capacity, batch_shape=(), dtype=torch.float64)
    for i in range(n):
        value = torch.tensor([float(i)], dtype=torch.float64)
        recent.keep(i, value, -value, None)
        recent.weigh(i, torch.tensor(0.5, dtype=torch.float64))
    return recent


def test_the_last_samples_are_kept_in_their_order_with_their_age():
    recent = filled(1_234, 500)
    x, y, on, weight = recent.last(1_234, 40)
    assert x[:, 0].tolist() == list(range(1_194, 1_234))
    assert torch.equal(y, -x)
    assert bool((on == 1.0).all() & (weight == 0.5).all())
    x, y, weight, age = recent.take(1_234, 500)
    assert sorted(x[:, 0].tolist()) == list(range(734, 1_234))
    assert torch.equal(age, 1_234 - x[:, 0])
    recent.forget(torch.tensor(True))
    assert float(recent.take(1_234, 500)[2].sum()) == 0
    assert float(recent.last(1_234, 40)[2].sum()) == 40


def test_turns_go_through_all_that_is_kept():
    recent = filled(500, 500)
    seen = torch.cat([recent.take(500, 64)[0][:, 0] for _ in range(7)])
    assert len(seen) == len(seen.unique()) == 7 * 64
    assert len(filled(10, 500).take(10, 64)[0]) == 10
    assert len(filled(0, 500).take(0, 64)[0]) == 0


def test_what_is_not_yet_part_of_the_state_is_not_taken_for_seen():
    x, y = system(3, 60)
    gp = sogp(4, 2, capacity=20, refresh_every=32, parts=[LearnHyperparameters(memory=500)])
    gp.update(x, y)  # rebuilt after 32
    queries = learning_of(gp).queries(gp, gp.n_samples)
    absorbed, counts = queries.absorbed > 0, queries.weight > 0
    assert int((counts & absorbed).sum()) == 32
    assert int((counts & ~absorbed).sum()) == 28
    assert not set(queries.x[counts & absorbed, 0].tolist()) & set(queries.x[~absorbed, 0].tolist())


def test_adaptation_beats_a_wrong_start():
    x, y = system(2, 900)
    wrong = {"capacity": 40, "kernel": SquaredExponential(4, lengthscale=0.3), "noise_variance": 0.5}
    errors, nll = [], []
    for adapt in (False, True):
        parts = [LearnHyperparameters()] if adapt else []
        gp = sogp(4, 2, **copy.deepcopy(wrong), parts=parts, refresh_every=8)
        run = run_prequential(gp, x, y)
        errors.append(float(run.error[600:].square().mean().sqrt()))
        nll.append(run.nll(600))
    assert errors[1] < 0.6 * errors[0]
    assert nll[1] < nll[0] - 0.3
    assert 0.003 < float(gp.noise_variance.mean()) < 0.06  # true: 0.01, plus what 40 points cannot explain


def test_each_output_finds_its_own_noise():
    x, y = system(5, 1200, noise=0.0)
    generator = torch.Generator().manual_seed(0)
    sd = torch.tensor([0.05, 0.4], dtype=torch.float64)
    y = y + sd * torch.randn(y.shape, generator=generator, dtype=torch.float64)
    parts = [LearnHyperparameters()]
    gp = sogp(4, 2, capacity=50, noise_variance=0.05, refresh_every=8, parts=parts)
    gp.update(x, y)
    found = gp.noise_variance.sqrt()
    assert 0.03 < float(found[0]) < 0.15
    assert 0.3 < float(found[1]) < 0.5


class Periodic(Kernel):
    """exp(-2 |sin(x - z)|^2): a kernel of a user's, without hyperparameters."""

    def forward(self, x: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        return (-2 * (x.unsqueeze(-2) - z.unsqueeze(-3)).sin().square().sum(-1)).exp()

    def diagonal(self, x: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(x[..., 0])

    def with_gradient(self, x: torch.Tensor, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        k = self.vector(x, z)
        return k, -2 * k.unsqueeze(-1) * (2 * (x.unsqueeze(-2) - z)).sin()


def test_a_kernel_without_hyperparameters_learns_the_noise_alone():
    gp = SparseOnlineGP(1, 1, kernel=Periodic(), standardize=False)
    x = 9 * torch.rand(200, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    start = float(gp.noise_variance)
    for one in x:  # six rebuilds
        gp.update(one, (2 * one).cos())
    assert float(gp.noise_variance) < start
    assert float((gp(x + math.pi) - (2 * x).cos()).detach().square().mean().sqrt()) < 0.05
    torch.testing.assert_close(gp.linearize(x[0])[1], torch.autograd.functional.jacobian(gp, x[0]))


class OfNoUse(SquaredExponential):
    """Its period changes nothing."""

    def __init__(self, in_features: int) -> None:
        super().__init__(in_features)
        self.period = torch.nn.Buffer(torch.tensor([2.0], dtype=torch.float64))

    def forward(self, x, z):
        return super().forward(x, z) + 0.0 * self.period.sum()


def test_what_is_neither_a_logarithm_nor_a_weight_does_not_decay():
    gp = SparseOnlineGP(4, 2, kernel=OfNoUse(4), batch_shape=(3,), parts=[LearnHyperparameters()])
    x, y = system(0, 300)
    gp.update(x.unsqueeze(1).expand(-1, 3, -1), y.unsqueeze(1).expand(-1, 3, -1))
    assert gp.kernel.period.tolist() == [[2.0]] * 3


def test_deep_kernel_starts_as_the_plain_one_and_does_not_collapse():
    x, y = system(11, 600)
    errors = []
    silent = DeepKernel(SquaredExponential(4), hidden=(16,))
    silent.weights[-1].mul_(1e-6)
    for kernel in (SquaredExponential(4), silent, DeepKernel(SquaredExponential(4), hidden=(16,))):
        gp = sogp(4, 2, capacity=40, kernel=kernel, parts=[LearnHyperparameters()])
        gp.update(x[:31], y[:31])
        early = gp(x[:31])
        gp.update(x[31:], y[31:])
        errors.append((early, float((gp(x) - y).square().mean())))
        assert float(torch.linalg.cond(gp.posterior.gram(gp.kernel))) < 1e9
    torch.testing.assert_close(errors[0][0], errors[1][0], atol=1e-6, rtol=0)
    assert errors[2][1] < 1.3 * errors[0][1]


def test_after_a_change_the_memory_holds_the_new_system_only():
    x, y = system(14, 700, noise=0.02)
    y = torch.cat([y[:400], -2.0 * y[400:]])
    parts = [RobustWeight(3.0), DetectChanges(), LearnHyperparameters(memory=200)]
    gp = sogp(4, 2, capacity=40, noise_variance=0.01, parts=parts)
    gp.update(x, y)
    memory = gp.recent
    kept = memory.x[memory.weight > 0]
    numbers = [int((x == row).all(-1).nonzero()) for row in kept]
    assert len(numbers) > 50
    assert min(numbers) >= 400


def test_the_memory_is_as_long_as_what_is_known_stays_true():
    assert learning_of(deep_sogp(4, 2)).memory == 2000
    assert learning_of(deep_sogp(4, 2, parts=[ProcessNoise(0.003)])).memory == 0
    parts = [ForgettingFactor(0.99), LearnHyperparameters(memory=2000)]
    assert sogp(4, 2, parts=parts).recent.capacity == 100


def test_a_robust_weight_alone_does_not_lock_another_system_out():
    """Samples that are distrusted in a row are believed; outliers that come alone are not."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(700, 2, generator=generator, dtype=torch.float64)
    y = torch.sin(x[:, :1]) + 0.02 * torch.randn(700, 1, generator=generator, dtype=torch.float64)
    y[400:] += 3.0
    parts = [RobustWeight(3.0), ForgettingFactor(0.99)]
    learner = SparseOnlineGP(2, 1, capacity=40, parts=parts, noise_variance=0.01)
    reports = [learner.update(x_t, y_t) for x_t, y_t in zip(x[:400], y[:400], strict=True)]
    outlier = learner.update(x[0], y[0] + 5.0)
    assert float(outlier.weight) < 0.1 < min(float(r.weight) for r in reports[100:])
    learner.update(x[400:], y[400:])
    assert float((learner(x[-50:]) - y[-50:]).square().mean().sqrt()) < 0.5
