"""What the sparse online GP must equal, each against an independent dense computation."""

import copy

import numpy as np
import pytest
import torch
from as_published import sogp

from torch_ekm.residual import (
    ActionLinearKernel,
    DeepKernel,
    ForgettingFactor,
    LinearKernel,
    Matern32,
    ProcessNoise,
    ResidualLearner,
    RobustWeight,
    SquaredExponential,
    Standardize,
    UpdateEvent,
)
from torch_ekm.residual.sparse_gp.engine import recursion

D, M, N, S2 = 4, 3, 40, 0.05


def data(n=N, d=D, m=M, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, d))
    w = rng.normal(size=(d, m))
    y = np.sin(x @ w) + np.sqrt(S2) * rng.normal(size=(n, m))
    return torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(rng.normal(size=(7, d)))


def se(x, z, lengthscale=1.3, variance=0.8):
    """Squared exponential in numpy, independent of the package."""
    d2 = ((x[:, None] - z[None]) ** 2).sum(-1) / lengthscale**2
    return variance * np.exp(-0.5 * d2)


def kernel(lengthscale=1.3, variance=0.8):
    return SquaredExponential(D, lengthscale=lengthscale, variance=variance)


def exact_gp(k, x, y, xs, s2=S2):
    """Mean and variance of a dense GP, in numpy."""
    x, y, xs = x.numpy(), y.numpy(), xs.numpy()
    L = np.linalg.cholesky(k(x, x) + s2 * np.eye(len(x)))
    A = np.linalg.solve(L, k(x, xs))
    mean = A.T @ np.linalg.solve(L, y)
    return torch.from_numpy(mean), torch.from_numpy(np.diag(k(xs, xs)) - (A * A).sum(0)), L


def learner(**options):
    options = {"capacity": N, "noise_variance": S2, "novelty_threshold": 0.0, **options}
    gp = sogp(D, M, kernel=options.pop("kernel", None) or kernel(), **options)
    gp.posterior.jitter = 0.0
    return gp


def on_basis(z, **options):
    """A learner at its prior on the basis vectors z, which others may not join if nothing is novel to it."""
    gp = learner(capacity=len(z), **options)
    posterior = gp.posterior
    posterior.basis[: len(z)], posterior.active[: len(z)] = z, 1.0
    posterior.count.fill_(len(z))
    posterior.slot.fill_(len(z))
    gp.refresh()
    return gp


#: Of a learner whose basis stays.
NOTHING_IS_NOVEL = {"novelty_threshold": 1.0 - 1e-9}


@pytest.mark.parametrize("order", ["given", "reversed", "shuffled"])
def test_unlimited_basis_is_the_exact_gp(order):
    x, y, xs = data()
    index = {"given": range(N), "reversed": range(N - 1, -1, -1)}.get(
        order, np.random.default_rng(1).permutation(N)
    )
    gp = learner()
    gp.update(x[list(index)], y[list(index)])
    mean, variance, _ = exact_gp(se, x, y, xs)
    torch.testing.assert_close(gp(xs), mean, atol=1e-8, rtol=0)
    torch.testing.assert_close(gp.predict(xs).variance, variance[:, None].expand(-1, M), atol=1e-8, rtol=0)


def test_exact_gradients_in_closed_form():
    """1e-8 against the dense posterior differentiated by hand, which finite differences cannot reach."""
    x, y, xs = data()
    gp = learner()
    gp.update(x, y)
    p = gp.predict_with_jacobians(xs)
    X, Y, Z = x.numpy(), y.numpy(), xs.numpy()
    K_inv = np.linalg.inv(se(X, X) + S2 * np.eye(N))
    for j in range(len(Z)):
        dk = se(Z[j : j + 1], X).T * (X - Z[j]) / 1.3**2
        mean = (K_inv @ Y).T @ dk
        variance = -2 * se(Z[j : j + 1], X) @ K_inv @ dk
        np.testing.assert_allclose(p.mean_jacobian[j].numpy(), mean, atol=1e-8)
        np.testing.assert_allclose(p.variance_jacobian[j, 0].numpy(), variance[0], atol=1e-8)


def test_sum_of_one_step_log_densities_is_the_evidence():
    x, y, _ = data()
    gp, total = learner(), 0.0
    for t in range(N):
        total += gp.predict(x[t], observation=True).log_prob(y[t]).sum()
        gp.update(x[t], y[t])
    L = exact_gp(se, x, y, x)[2]
    a = np.linalg.solve(L, y.numpy())
    evidence = -0.5 * (a * a).sum() - M * np.log(np.diag(L)).sum() - 0.5 * N * M * np.log(2 * np.pi)
    assert float(total) == pytest.approx(evidence, abs=1e-8)


def test_fixed_basis_is_dtc():
    """q(y) = N(0, Qff + s2 I): Quinonero-Candela & Rasmussen 2005, eqs. 19-27."""
    x, y, xs = data()
    z = data(12, seed=3)[0]
    gp = on_basis(z, **NOTHING_IS_NOVEL)
    gp.update(x, y)
    X, Y, Z, T = x.numpy(), y.numpy(), z.numpy(), xs.numpy()
    Kuu, Kuf, Kus = se(Z, Z), se(Z, X), se(Z, T)
    lam = S2 * np.ones(N)
    S = Kuu + (Kuf / lam) @ Kuf.T
    mean = Kus.T @ np.linalg.solve(S, (Kuf / lam) @ Y)
    variance = 0.8 + (Kus * (np.linalg.solve(S, Kus) - np.linalg.solve(Kuu, Kus))).sum(0)
    np.testing.assert_allclose(gp(xs).numpy(), mean, atol=1e-8)
    np.testing.assert_allclose(gp.predict(xs).variance[:, 0].numpy(), variance, atol=1e-8)
    gp.refresh()
    np.testing.assert_allclose(gp(xs).numpy(), mean, atol=1e-8)


def test_a_pruned_step_is_the_streaming_variational_step():
    """Bui, Nguyen & Turner 2017 with inducing points restricted to data: optimal q(f_new).

    Old inducing points a with q(a), old prior p(a); one new sample; new inducing points b:
    precision of q(b) = K_bb^-1 + E_a'(S_a^-1 - K_aa^-1)E_a + E_f'E_f/s2, E the conditional means.
    """
    x, y, xs = data()
    gp = learner(capacity=10, refresh_every=10**6)
    gp.update(x[:20], y[:20])
    for n in range(20, N):  # up to the first sample that takes another point's place
        before = copy.deepcopy(gp)
        if gp.update(x[n], y[n]).event == UpdateEvent.REPLACED and before.posterior.slot != gp.posterior.slot:
            break
    else:
        pytest.fail("no sample replaced a basis vector")
    old = before.posterior.active.bool()
    a, b = before.posterior.basis[old].numpy(), gp.posterior.basis[gp.posterior.active.bool()].numpy()
    assert not np.array_equal(a, b)
    Kaa = se(a, a)
    mu_a = Kaa @ before.posterior.alpha[old].numpy()
    S_a = Kaa + Kaa @ before.posterior.moments[0][old][:, old].numpy() @ Kaa
    W_a = np.linalg.inv(S_a) - np.linalg.inv(Kaa)
    Kbb = se(b, b)
    Ea = np.linalg.solve(Kbb, se(b, a)).T
    Ef = np.linalg.solve(Kbb, se(b, x[n : n + 1].numpy())).T
    P = np.linalg.inv(Kbb) + Ea.T @ W_a @ Ea + Ef.T @ Ef / S2
    mu_b = np.linalg.solve(P, Ea.T @ np.linalg.solve(S_a, mu_a) + Ef.T @ y[n : n + 1].numpy() / S2)
    Ks = se(xs.numpy(), b)
    A = np.linalg.solve(Kbb, Ks.T).T
    np.testing.assert_allclose(gp(xs).numpy(), A @ mu_b, atol=1e-8)
    variance = 0.8 - (A * Ks).sum(1) + ((A @ np.linalg.inv(P)) * A).sum(1)
    np.testing.assert_allclose(gp.predict(xs).variance[:, 0].numpy(), variance, atol=1e-8)


def test_deleting_the_newest_is_the_projection(monkeypatch):
    x, y, xs = data()
    gp = on_basis(x[:10], refresh_every=10**6, **NOTHING_IS_NOVEL)
    gp.update(x[10], y[10])
    monkeypatch.setattr(
        recursion, "pruning_loss", lambda posterior, c, q, w: (posterior.slots != 10).double()
    )
    other = on_basis(x[:10], refresh_every=10**6)
    other.engine = None  # that is what was patched
    assert other.update(x[10], y[10]).event == UpdateEvent.REPLACED
    assert int(other.posterior.slot) == 10
    torch.testing.assert_close(other(xs), gp(xs), atol=1e-11, rtol=0)
    torch.testing.assert_close(other.predict(xs).variance, gp.predict(xs).variance, atol=1e-11, rtol=0)


@pytest.mark.parametrize("capacity", [12, N])
def test_recursion_equals_a_rebuild_from_the_natural_form(capacity):
    x, y, xs = data()
    gp = learner(capacity=capacity, refresh_every=10**6, novelty_threshold=1e-3)
    gp.update(x, y)
    mean, variance = gp(xs), gp.predict(xs).variance
    gp.refresh()
    torch.testing.assert_close(gp(xs), mean, atol=1e-9, rtol=0)
    torch.testing.assert_close(gp.predict(xs).variance, variance, atol=1e-9, rtol=0)


def test_kernel_and_noise_change_without_data():
    x, y, xs = data()
    gp = learner()
    gp.update(x, y)
    gp.kernel.log_lengthscale.fill_(np.log(0.9))
    gp.kernel.log_variance.fill_(np.log(1.7))
    gp.log_noise_variance.fill_(np.log(0.02))
    gp.refresh()
    mean, variance, _ = exact_gp(lambda a, b: se(a, b, 0.9, 1.7), x, y, xs, 0.02)
    torch.testing.assert_close(gp(xs), mean, atol=1e-8, rtol=0)
    torch.testing.assert_close(gp.predict(xs).variance[:, 0], variance, atol=1e-8, rtol=0)


def test_kl_score_is_the_true_divergence():
    """2 KL(q || projected q) between the two posteriors on the old basis, from dense Gaussians."""
    x, y, _ = data()
    gp = learner(capacity=10, refresh_every=10**6)
    gp.update(x[:10], y[:10])
    gp.refresh()
    c, q, w = gp.posterior.moments.diagonal(dim1=-2, dim2=-1)
    scores = recursion.pruning_loss(gp.posterior, c, q, w / S2)[:10]
    K = se(x[:10].numpy(), x[:10].numpy())

    def posterior(W, h):
        P = np.linalg.inv(K) + W
        return np.linalg.solve(P, h), np.linalg.inv(P)

    W, h = gp.posterior.moments[2, :10, :10].numpy() / S2, gp.posterior.vectors[1, :10].numpy() / S2
    mu, S = posterior(W, h)
    for i in range(10):
        keep = [j for j in range(10) if j != i]
        E = np.zeros((10, 9))
        E[keep, range(9)] = 1.0
        E[i] = np.linalg.solve(K[np.ix_(keep, keep)], K[keep, i])
        W_keep, h_keep = np.zeros((10, 10)), np.zeros((10, M))
        W_keep[np.ix_(keep, keep)], h_keep[keep] = E.T @ W @ E, E.T @ h
        mu_i, S_i = posterior(W_keep, h_keep)
        # Csato's KL(projected || full); its mean term is the same in each direction up to S
        d = mu_i - mu
        kl2 = (d * np.linalg.solve(S, d)).sum() + M * (
            np.trace(np.linalg.solve(S, S_i)) - 10 + np.linalg.slogdet(S)[1] - np.linalg.slogdet(S_i)[1]
        )
        assert float(scores[i]) == pytest.approx(kl2, abs=1e-8)


@pytest.mark.parametrize("every", [1, 4])
def test_forgetting_is_a_weighted_gp(every):
    """With a rebuild every 4 samples, sample t of 40 has been forgotten 4 (10 - t // 4) times."""
    x, y, xs = data()
    gp = learner(parts=[ForgettingFactor(0.9)], refresh_every=every)
    gp.update(x, y)
    weight = 0.9 ** (every * (N // every - np.arange(N) // every))
    X, Y, T = x.numpy(), y.numpy(), xs.numpy()
    A = se(X, X) + np.diag(S2 / weight)
    np.testing.assert_allclose(gp(xs).numpy(), se(T, X) @ np.linalg.solve(A, Y), atol=1e-8)
    variance = 0.8 - (se(T, X) * np.linalg.solve(A, se(X, T)).T).sum(1)
    np.testing.assert_allclose(gp.predict(xs).variance[:, 0].numpy(), variance, atol=1e-8)


@pytest.mark.parametrize("every", [1, 5])
def test_process_noise_is_the_exact_gp_in_space_and_time(every):
    """f wanders like an Ornstein-Uhlenbeck process, one step per rebuild: k(x, x') kept^(|t - t'|/2)."""
    x, y, xs = data()
    gp = learner(parts=[ProcessNoise(0.05)], refresh_every=every)
    gp.update(x, y)
    now = np.arange(N + 1) // every * every

    def in_time(a, b, times_a, times_b):
        return se(a, b) * 0.95 ** (np.abs(times_a[:, None] - times_b[None]) / 2)

    later = np.full(len(xs), now[N])
    K = in_time(x.numpy(), x.numpy(), now[:N], now[:N]) + S2 * np.eye(N)
    ks = in_time(x.numpy(), xs.numpy(), now[:N], later)
    variance = 0.8 - (ks * np.linalg.solve(K, ks)).sum(0)
    np.testing.assert_allclose(gp(xs).numpy(), ks.T @ np.linalg.solve(K, y.numpy()), atol=1e-8)
    np.testing.assert_allclose(gp.predict(xs).variance[:, 0].numpy(), variance, atol=1e-8)


def test_robust_weight_scales_the_gain_beyond_c():
    """One update by hand: the mean moves by ``w k/(s2 + v) i``, w = min(1, c^2/z2), v shrinks alike."""
    x, y, _ = data()
    for shift, outlier in ((0.05, False), (3.0, True)):
        gp = learner(parts=[RobustWeight(2.0)])
        gp.update(x[:20], y[:20])
        law, latent = gp.predict(x[20], observation=True), gp.predict(x[20]).variance
        innovation = law.mean + shift - law.mean
        z2 = (innovation / law.stddev).square().mean()
        report = gp.update(x[20], law.mean + shift)
        weight = min(1.0, float(4.0 / z2))
        assert (weight < 1.0) == outlier
        torch.testing.assert_close(report.nis, z2, rtol=1e-7, atol=0)
        torch.testing.assert_close(report.weight, torch.tensor(weight).double(), rtol=1e-7, atol=0)
        gain = weight * latent / law.variance
        torch.testing.assert_close(gp(x[20]), law.mean + gain * innovation, atol=1e-9, rtol=0)
        torch.testing.assert_close(gp.predict(x[20]).variance, latent * (1 - gain), atol=1e-9, rtol=0)


def test_fleet_equals_single_models():
    generator, shape = torch.Generator().manual_seed(3), (2, 3)
    x = torch.randn(60, *shape, D, generator=generator, dtype=torch.float64)
    y = torch.randn(60, *shape, M, generator=generator, dtype=torch.float64)
    parts = [RobustWeight(3.0), Standardize()]
    options = {"capacity": 12, "novelty_threshold": 0.05, "refresh_every": 10**6, "parts": parts}
    fleet = learner(batch_shape=shape, **options)
    fleet.update(x, y)
    xs = data()[2]
    law = fleet.predict(xs[:, None, None])
    for i, j in np.ndindex(shape):
        single = learner(**options)
        single.update(x[:, i, j], y[:, i, j])
        torch.testing.assert_close(law.mean[:, i, j], single(xs), atol=1e-10, rtol=0)
        torch.testing.assert_close(law.stddev[:, i, j], single.predict(xs).stddev, atol=1e-10, rtol=0)


KERNELS = {
    "se": lambda: SquaredExponential(D, lengthscale=[0.7, 1.0, 1.5, 2.0]),
    "matern32": lambda: Matern32(D),
    "linear": lambda: LinearKernel(D, slope_variance=[0.5, 1.0, 2.0, 4.0], variance=0.7),
    "action": lambda: ActionLinearKernel(D, 2, state_kernel=Matern32(2), action_variance=[0.5, 2.0]),
    "deep": lambda: DeepKernel(SquaredExponential(D)),
}


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("parts", [[], [Standardize()]])
def test_closed_form_gradients_are_autograds(name, parts):
    x, y, xs = data()
    gp = sogp(D, M, capacity=15, kernel=KERNELS[name](), parts=parts)
    gp.update(x * 3 + 1, y * 5)
    p = gp.predict_with_jacobians(xs)
    mean, jacobian = ResidualLearner.linearize(gp, xs)
    torch.testing.assert_close(p.mean, mean, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(p.mean_jacobian, jacobian, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(gp.linearize(xs)[1], jacobian, atol=1e-9, rtol=1e-9)
    torch.testing.assert_close(p.variance, gp.predict(xs).variance, atol=1e-9, rtol=1e-9)
    v = torch.func.vmap(torch.func.jacrev(lambda one: gp.predict(one).variance))(xs)
    torch.testing.assert_close(p.variance_jacobian, v, atol=1e-8, rtol=1e-8)
    assert torch.autograd.gradcheck(gp, (xs.requires_grad_(True),))


def test_matern_gradient_at_a_basis_point_is_finite():
    x, y, _ = data()
    gp = sogp(D, M, capacity=15, kernel=Matern32(D))
    gp.update(x[:10], y[:10])
    _, jacobian = ResidualLearner.linearize(gp, x[0])
    torch.testing.assert_close(gp.linearize(x[0])[1], jacobian, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("parts", [[], [Standardize()]])
def test_action_linear_kernel(parts):
    x, y, xs = data()
    gp = sogp(D, M, capacity=15, kernel=KERNELS["action"](), parts=parts)
    gp.update(x * 2 + 1, y * 7)
    s, a = xs[:, :2], xs[:, 2:]
    G = gp.linearize(xs)[1][..., 2:]
    units = torch.cat([s.expand(2, *s.shape), torch.eye(2).double().unsqueeze(1).expand(2, *s.shape)], -1)
    V = 0.5 * gp.predict_with_jacobians(units).variance_jacobian[..., 2:].movedim(0, -2)  # var is a'V a
    torch.testing.assert_close(gp(xs), (G @ a[..., None])[..., 0], atol=1e-10, rtol=1e-10)
    quadratic = (a[:, None, None] @ V @ a[:, None, :, None])[..., 0, 0]
    torch.testing.assert_close(gp.predict(xs).variance, quadratic, atol=1e-9, rtol=1e-9)
    assert torch.all(gp(torch.cat([s, 0 * a], -1)) == 0)
    assert float(torch.linalg.eigvalsh(V).min()) > 0
