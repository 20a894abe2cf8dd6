"""Targets that come some samples after their inputs."""

import pytest
import torch
from as_published import sogp

from torch_ekm import EnhancedModel
from torch_ekm.exceptions import ShapeError
from torch_ekm.residual import MixtureResidual, ResidualLearner, SparseOnlineGP

LATE = 5


def smooth_stream(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    t = 0.05 * torch.arange(n, dtype=torch.float64).unsqueeze(-1)
    x = torch.cat([torch.sin(t), torch.sin(1.7 * t + 1.0), torch.sin(0.3 * t)], -1)
    return x, torch.sin(3.0 * x[:, :1] * x[:, 1:2]) + x[:, 2:]


def mixture(**options) -> MixtureResidual:
    learners = [SparseOnlineGP(3, 1, capacity=20, **options)]
    return MixtureResidual(learners, levels=(0.0, 0.1, 1.0), trends=(0.0, 0.5))


def held(g: ResidualLearner, *, expected: bool) -> float:
    """Share of y in 90 % intervals where y comes late, over the second half."""
    (x, y), kept, inside = smooth_stream(400), [], []
    for i in range(len(x)):
        kept.append(g.expect(x[i]) if expected else x[i])
        inside.append(float((g.predictive(x[i]).cdf(y[i]) - 0.5).abs() < 0.45))
        if i >= LATE:
            g.update(kept[i - LATE], y[i - LATE])
    return sum(inside[200:]) / 200


def test_a_mixture_is_judged_by_what_it_said_when_the_input_was_there() -> None:
    assert held(mixture(), expected=False) < 0.5
    assert held(mixture(), expected=True) > 0.75


@pytest.mark.parametrize("fleet", [(), (2,)])
def test_a_target_that_is_not_late_teaches_the_same(fleet: tuple[int, ...]) -> None:
    one, other = mixture(batch_shape=fleet), mixture(batch_shape=fleet)
    x, y = (t[:, None].expand(-1, 2, -1) if fleet else t for t in smooth_stream(40))
    for x_t, y_t in zip(x, y, strict=True):
        one.update(x_t, y_t)
        other.update(other.expect(x_t), y_t)
    for a, b in zip(one.buffers(), other.buffers(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-9, rtol=1e-9)


def test_an_enhanced_model_hands_on_what_was_expected() -> None:
    x, y = smooth_stream(30)
    ekm, g = EnhancedModel(lambda s, a: 2.0 * a, mixture(), action_scale=2.0), mixture()
    waiting = []
    for i in range(30):
        state, action = x[i, :2], x[i, 2:] / 2.0
        waiting.append((state, action, y[i], ekm.expect(state, action), g.expect(x[i])))
        if i >= LATE:
            state, action, increment, of_ekm, of_g = waiting.pop(0)
            ekm.update(state, action, increment + 2.0 * action, expected=of_ekm)
            g.update(of_g, increment)
    torch.testing.assert_close(ekm.learner(x), g(x), atol=1e-9, rtol=1e-9)


def test_any_learner_takes_what_it_was_told_to_expect() -> None:
    x, y = smooth_stream(10)
    one, other = sogp(3, 1), sogp(3, 1)
    kept = [other.expect(x_t) for x_t in x.clone()]
    for i in range(10):
        one.update(x[i], y[i])
        other.update(kept[i], y[i])
    torch.testing.assert_close(other(x), one(x), atol=0, rtol=0)
    with pytest.raises(ShapeError):
        one.expect(x)
