"""The mixture finds out what noise carries over, whom to trust, and how heavy the tails are."""

import copy
import math
from typing import Any

import pytest
import torch
from as_published import in_turn, share_left, sogp
from torch.distributions import StudentT

from torch_ekm.experiments.learner_comparison.prequential import run_prequential
from torch_ekm.residual import (
    LearnHyperparameters,
    MixtureResidual,
    ProcessNoise,
    RecursiveLeastSquares,
    RobustWeight,
    SparseOnlineGP,
    ZeroResidual,
    default_learner,
)


def noisy_pose(seed: int, n: int, pose: float, motion: float = 0.1):
    """Increments of a pose measured with noise: ``y = g(x) + motion noise + e(t+1) - e(t)``."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 2, generator=generator, dtype=torch.float64)
    e = pose * torch.randn(n + 1, 1, generator=generator, dtype=torch.float64)
    q = motion * torch.randn(n, 1, generator=generator, dtype=torch.float64)
    return x, 0.5 * x[:, :1] + q + e[1:] - e[:-1]


def steady_kappa(pose: float, motion: float) -> float:
    """Root of ``kappa/(1 + kappa^2) = pose^2/(2 pose^2 + motion^2)``: the MA(1) of such increments."""
    rho = pose**2 / (2 * pose**2 + motion**2)
    return (1 - math.sqrt(1 - 4 * rho**2)) / (2 * rho)


def linear(**options):
    return RecursiveLeastSquares(2, 1, noise_variance=0.1, **options)


def side_by_side(streams):
    """Streams ``(n, d)`` as those of a fleet ``(n, streams, d)``."""
    return [torch.stack(part, dim=1) for part in zip(*streams, strict=True)]


def test_carry_reaches_the_kalman_filters_error():
    """The best error of one step is that of the moving average: ``sd(y - g) / sqrt(1 + kappa^2)``."""
    cases = [(0.0, 0.3), (0.3, 0.3), (0.3, 0.1)]
    x, y = side_by_side([noisy_pose(0, 1500, pose, motion) for pose, motion in cases])
    mixture = MixtureResidual(linear(batch_shape=(3,)))
    errors = in_turn(mixture, x, y)[500:].square().mean(0).sqrt().flatten()
    carried = (mixture.beliefs * mixture._experts[1]).sum(-1).flatten()
    for (pose, motion), error, found in zip(cases, errors.tolist(), carried.tolist(), strict=True):
        kappa = steady_kappa(pose, motion) if pose else 0.0
        best = math.sqrt((2 * pose**2 + motion**2) / (1 + kappa**2))
        assert error < 1.05 * best
        assert found == pytest.approx(kappa, abs=0.15)


def test_what_cannot_be_learned_costs_next_to_nothing():
    """Pure heavy-tailed noise: a plain GP makes the model worse, the mixture steps back."""
    generator = torch.Generator().manual_seed(2)
    x = torch.randn(600, 3, generator=generator, dtype=torch.float64)
    torch.manual_seed(2)
    y = StudentT(2.5).sample((600, 1)).double()
    ratios = []
    for wrap in (MixtureResidual, lambda learner: learner):
        learner = wrap(sogp(3, 1, capacity=40, noise_variance=0.1, parts=[ProcessNoise(0.003)]))
        run = run_prequential(learner, x, y)
        ratios.append(float(run.error[100:].square().mean().sqrt() / y[100:].square().mean().sqrt()))
    assert ratios[1] > 1.05
    assert ratios[0] < 1.02


def test_the_better_learner_of_two_is_found_per_output():
    generator = torch.Generator().manual_seed(3)
    x = torch.randn(500, 2, generator=generator, dtype=torch.float64)
    noise = 0.05 * torch.randn(500, 2, generator=generator, dtype=torch.float64)
    y = torch.cat([x[:, :1], torch.zeros(500, 1, dtype=torch.float64)], 1) + noise
    learners = [RecursiveLeastSquares(2, 2), ZeroResidual(2, 2)]
    mixture = MixtureResidual(learners)
    mixture.update(x, y)
    assert float(mixture.weights[0, 0]) > 0.99
    assert float((mixture(x[:50]) - y[:50]).square().mean().sqrt()) < 0.06


def test_level_follows_an_offset():
    """An offset that jumps: learners that forget nothing are helped by the level experts."""
    generator = torch.Generator().manual_seed(4)
    x = torch.randn(400, 2, generator=generator, dtype=torch.float64)
    y = x[:, :1] + 0.05 * torch.randn(400, 1, generator=generator, dtype=torch.float64)
    y[200:] += 0.5
    plain, mixture = linear(), MixtureResidual(linear())
    errors = [
        run_prequential(learner, x, y).error[230:].square().mean().sqrt() for learner in (plain, mixture)
    ]
    assert float(errors[1]) < 0.4 * float(errors[0])


def test_predictive_law_is_better_than_normal_on_heavy_tails_and_no_worse_on_light_ones():
    torch.manual_seed(5)
    x = torch.randn(1000, 2, 2, dtype=torch.float64)
    nu = torch.tensor([[2.0], [1e6]], dtype=torch.float64)
    y = 0.2 * StudentT(nu).sample((1000,))
    mixture = MixtureResidual(ZeroResidual(2, 1, batch_shape=(2,)))
    own, normal = [], []
    for n, (x_t, y_t) in enumerate(zip(x, y, strict=True)):
        if n >= 300:
            own.append(-mixture.predictive(x_t).log_prob(y_t))
            normal.append(-mixture.predict(x_t, observation=True).log_prob(y_t))
        mixture.update(x_t, y_t)
    told, as_normal = (torch.stack(parts).mean(0).flatten().tolist() for parts in (own, normal))
    true = -StudentT(nu, 0.0, 0.2).log_prob(y[300:]).mean(0).flatten()
    for mine, other, best, gain in zip(told, as_normal, true.tolist(), (0.2, -0.03), strict=True):
        assert mine < other - gain
        assert mine < best + 0.06


def test_a_fleet_is_so_many_single_mixtures():
    n = 96
    x, y = noisy_pose(8, n, 0.3)
    x, y = torch.stack([x, x.flip(0), 2 * x], 1), torch.stack([y, y.flip(0), -y], 1)
    generator = torch.Generator().manual_seed(0)
    mask = torch.rand(n, 3, generator=generator) < 0.7
    mask[:77] = True  # up to the last rebuild, which comes at the same step for all models

    def make(**options):
        gp = sogp(2, 1, capacity=10, parts=[RobustWeight(3.0)], **options)
        return MixtureResidual([gp, linear(standardize=False, **options)])

    fleet = make(batch_shape=(3,))
    fleet.update(x, y, mask)
    for i in range(3):
        single = make()
        for t in range(n):
            single.update(x[t, i], y[t, i], mask[t, i])
        torch.testing.assert_close(single(x[:5, i]), fleet(x[:5])[:, i], atol=1e-10, rtol=0)
        law, laws = single.predictive(x[:5, i]), fleet.predictive(x[:5])
        torch.testing.assert_close(law.log_prob(y[:5, i]), laws.log_prob(y[:5])[:, i], atol=1e-9, rtol=0)


def test_at_first_a_learner_is_taken_at_its_word():
    mixture, plain = MixtureResidual(linear()), linear()
    x = torch.eye(2, dtype=torch.float64)
    for learner in (mixture, plain):
        learner.update(x, 0.5 * x[:, :1])
    assert float(mixture.gain) > 0.75
    assert float(mixture(x[0])) == pytest.approx(float(plain(x[0])), rel=0.3)


def test_learners_are_trained_on_y_itself():
    x, y = noisy_pose(9, 200, 0.3)
    mixture, alone = MixtureResidual(linear()), linear()
    mixture.update(x, y)
    alone.update(x, y)
    assert torch.equal(mixture.members[0](x[:9]), alone(x[:9]))
    assert float(mixture.offset.abs()) > 0.01


def test_a_fast_level_and_its_trend_follow_a_smooth_stream():
    """y = t + sin t, and x tells nothing: what the last samples left tells all."""
    t = torch.arange(200, dtype=torch.float64).unsqueeze(-1) / 20.0
    y = 0.3 * t + torch.sin(t)
    errors = []
    for levels, trends in (((0.0,), (0.0,)), ((0.0, 1.0), (0.0,)), ((0.0, 1.0), (0.0, 0.5))):
        mixture = MixtureResidual(ZeroResidual(1, 1), levels=levels, trends=trends)
        run = run_prequential(mixture, 0.0 * t, y)
        errors.append(float(run.error[100:].square().mean().sqrt()))
    assert errors[1] < 0.05 * errors[0]
    assert errors[2] < 0.3 * errors[1]


def test_the_report_is_that_of_all_members() -> None:
    """One member knows the place and the other does not: each counts by its weight."""
    torch.manual_seed(0)
    seen, empty = (sogp(2, 1, capacity=20, parts=[]) for _ in range(2))
    x, y = torch.rand(20, 2, dtype=torch.float64), torch.rand(20, 1, dtype=torch.float64)
    seen.update(x, y)
    own = [float(copy.deepcopy(one).update(x[0], y[0]).novelty) for one in (seen, empty)]
    mixture = MixtureResidual([seen, empty])
    report = mixture.update(x[0], y[0])
    expected = float(mixture.weights.mean(-2) @ torch.tensor(own, dtype=torch.float64))
    assert own[0] < 0.1 < 0.9 < own[1]
    assert float(report.novelty) == pytest.approx(expected)


@pytest.mark.parametrize("fleet", [(), (3,)])
def test_compiled_loops_judge_as_torch_does(fleet) -> None:
    made = [default_learner(3, 2, capacity=8, batch_shape=fleet, on_invalid="skip") for _ in range(2)]
    made[1]._engine.learn = made[1]._engine.ask = lambda *given: None
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(45, *fleet, 3, generator=generator, dtype=torch.float64)
    y = torch.sin(x[..., :2]) + 0.1 * torch.randn(45, *fleet, 2, generator=generator, dtype=torch.float64)
    y[20] *= 1e3
    x[21, ..., 0] = torch.nan
    on = torch.rand(45, *fleet, generator=generator) < 0.9
    for t in range(len(x)):
        reports = [g.update(x[t], y[t], on[t]) for g in made]
        torch.testing.assert_close(*[report.nis for report in reports], atol=1e-10, rtol=1e-8)
    for ask in ("forward", "predict_with_jacobians"):
        torch.testing.assert_close(*[getattr(g, ask)(x[0]) for g in made], atol=1e-10, rtol=1e-8)
    torch.testing.assert_close(*[g.predict(x[0]).stddev for g in made], atol=1e-10, rtol=1e-8)
    laws = [g.predictive(x[0]).log_prob(y[0]) for g in made]
    torch.testing.assert_close(*laws, atol=1e-10, rtol=1e-8)


def test_variance_and_slopes_are_those_of_all_experts() -> None:
    g = default_learner(3, 2, capacity=8)
    x = torch.randn(60, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    g.update(x, torch.sin(x[:, :2]))
    means, variances = (
        torch.stack(each, -1) for each in zip(*(m.moments(x[0]) for m in g.members), strict=True)
    )
    each = g.shares * (means @ g.owner.mT) + g.carried
    within = g.shares.square() * (variances @ g.owner.mT)
    mean = (g.beliefs * each).sum(-1)
    expected = (g.beliefs * (within + (each - mean.unsqueeze(-1)).square())).sum(-1)
    torch.testing.assert_close(g._spread(variances, g._apart(means, mean)), expected, atol=0, rtol=1e-9)
    law = g.predict(x[0])
    torch.testing.assert_close(law.mean, mean)
    limit = g.predict(x[0], observation=True).variance
    torch.testing.assert_close(law.variance, torch.minimum(expected, limit))


def test_learners_rebuild_and_descend_at_different_samples(monkeypatch) -> None:
    g, t = default_learner(3, 2, capacity=8), 0
    rebuilt: list[tuple[int, int]] = []
    descended: list[tuple[int, int]] = []
    for i, member in enumerate(g.members):
        gp: Any = member
        learning = gp.part(LearnHyperparameters)
        for of, name, seen in ((gp, "refresh", rebuilt), (learning, "descend", descended)):
            own = getattr(of, name)

            def call(*given, i=i, own=own, seen=seen, **options):
                seen.append((t, i))
                return own(*given, **options)

            monkeypatch.setattr(of, name, call)
    x = torch.randn(192, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for t in range(192):
        g.update(x[t], x[t, :2])
    late, steps = ({pair for pair in pairs if pair[0] >= 128} for pairs in (rebuilt, descended))
    assert len(late) == len({t for t, _ in late}) == 8  # four rebuilds in 32 samples
    # a step before each, of two learners one halfway, too; deep ones in parts, with samples of their own
    assert len(steps) == len({t for t, _ in steps}) == 12
    heavy = [t - part for t, i in steps if i < 2 for part in range(3)]
    assert len(heavy) == len(set(heavy))
    assert not set(heavy) & {t for t, i in (*late, *steps) if i == 2}


def test_the_default_keeps_a_linear_map() -> None:
    """Three of 32 inputs matter, with as much noise: members that forget, or are local, err by 0.43."""
    draw = torch.Generator().manual_seed(1)
    x = torch.randn(900, 32, generator=draw, dtype=torch.float64)
    clean = x[:, :3] @ torch.randn(3, 1, generator=draw, dtype=torch.float64)
    clean = clean / clean.std()
    y = clean + torch.randn(900, 1, generator=draw, dtype=torch.float64)
    run = run_prequential(default_learner(32, 1), x, y)
    assert float((run.mean - clean)[600:].square().mean().sqrt()) < 0.37


def test_one_sentinel_does_not_inflate_what_is_stated_for_long() -> None:
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(420, 4, generator=draw, dtype=torch.float64)
    y = torch.sin(x[:, :1]) + 0.05 * torch.randn(420, 1, generator=draw, dtype=torch.float64)
    y[300] = -999.0
    g, stated = default_learner(4, 1), []
    for t in range(len(x)):
        stated.append(float(g.predict(x[t], observation=True).stddev))
        g.update(x[t], y[t])
    assert stated[301] < 2 * stated[300]
    assert stated[-1] < 1.5 * stated[300]


def test_a_scale_that_grows_is_stated_soon() -> None:
    draw = torch.Generator().manual_seed(0)
    x, y = (torch.randn(360, d, generator=draw, dtype=torch.float64) for d in (2, 1))
    y[300:] *= 1e3
    g = default_learner(2, 1)
    g.update(x, y)
    assert 300 < float(g.predict(x[0], observation=True).stddev) < 6000


def test_the_third_sample_of_a_stream_that_begins_close_together_is_not_extrapolated() -> None:
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(3, 26, generator=draw, dtype=torch.float64)
    x[1] = x[0] + 0.01 * x[1]
    y = torch.tensor([[1.0], [1.2], [1.0]], dtype=torch.float64)
    g = default_learner(26, 1)
    g.update(x[:2], y[:2])
    assert abs(float(g(x[2]))) < 6.0  # 18.6 if the line is believed like the others


def test_a_doubt_is_there_again_after_a_reset() -> None:
    g = MixtureResidual([linear(), linear()], doubts=(0.0, 2.0))
    first = g.weights.clone()
    assert float(first[0, 1] / first[0, 0]) == pytest.approx(math.exp(-2.0))
    g.update(*noisy_pose(3, 40, 0.3))
    assert not torch.equal(g.weights, first)
    g.reset()
    assert torch.equal(g.weights, first)


# -- systems that change and change back -----------------------------------------------------------------


def there_and_back(seed: int, n: tuple[int, int, int] = (300, 200, 50)) -> tuple[torch.Tensor, torch.Tensor]:
    """Two linear systems, the first one twice."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(sum(n), 3, generator=g, dtype=torch.float64)
    first, second = torch.randn(2, 3, 2, generator=g, dtype=torch.float64)
    between = torch.zeros(sum(n), 1, dtype=torch.bool)
    between[n[0] : n[0] + n[1]] = True
    y = torch.where(between, x @ second, x @ first)
    return x, y + 0.05 * torch.randn(sum(n), 2, generator=g, dtype=torch.float64)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_system_that_comes_back_is_known(seed):
    learner = default_learner(3, 2)
    x, y = there_and_back(seed)
    learner.update(x[:500], y[:500])
    forgetful = copy.deepcopy(learner)
    forgetful.returns = None
    with_it, without = share_left(learner, x[500:], y[500:]), share_left(forgetful, x[500:], y[500:])
    assert with_it < 0.3
    assert without > 2.0 * with_it


def test_what_is_known_travels_with_the_learner():
    learner, other = default_learner(3, 2), default_learner(3, 2)
    x, y = there_and_back(1)
    learner.update(x[:450], y[:450])
    other.load_state_dict(learner.state_dict())
    ends = [share_left(one, x[450:], y[450:]) for one in (learner, copy.deepcopy(learner), other)]
    assert ends[0] == pytest.approx(ends[1], rel=1e-6) == pytest.approx(ends[2], rel=1e-6)


def test_after_a_reset_no_regime_is_known():
    learner = default_learner(3, 2)
    x, y = there_and_back(1)
    learner.update(x[:400], y[:400])
    assert learner.returns.known["evidence"]
    learner.reset()
    assert not learner.returns.known["evidence"]


def test_without_a_learner_that_notes_changes_nothing_is_kept():
    assert MixtureResidual(SparseOnlineGP(2, 1, parts=[])).returns is None
    assert default_learner(2, 1, batch_shape=(2,)).returns is None
