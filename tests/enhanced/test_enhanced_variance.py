"""The learner's variance as a convex quadratic in the action."""

from __future__ import annotations

import pytest
import torch

from torch_ekm.enhanced import EnhancedModel
from torch_ekm.enhanced.action_variance import action_variance
from torch_ekm.exceptions import ParameterError
from torch_ekm.experiments.learners import HAND_LEARNERS, make_learner
from torch_ekm.object_memory import ModelBank
from torch_ekm.residual import (
    ActionLinearKernel,
    Part,
    ReplayMLP,
    ResidualLearner,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
    ZeroResidual,
)

N_S, N_A, N_OUT = 3, 2, 3


def linear_learner(**options) -> SparseOnlineGP:
    kernel = ActionLinearKernel(N_S + N_A, N_A, action_variance=[0.5, 2.0])
    chosen = {"capacity": 20, "kernel": kernel, "noise_variance": 0.05, "parts": (), "standardize": False}
    return SparseOnlineGP(N_S + N_A, N_OUT, **{**chosen, **options})


def train(learner: ResidualLearner, generator: torch.Generator, n: int = 40) -> ResidualLearner:
    x = torch.randn(n, learner.in_features, generator=generator, dtype=torch.float64)
    learner.update(x, torch.randn(n, learner.out_features, generator=generator, dtype=torch.float64))
    return learner


@pytest.mark.parametrize("parts", [[], [Standardize()]])
def test_exact_for_every_action_with_an_action_linear_kernel(
    parts: list[Part], generator: torch.Generator
) -> None:
    scale = torch.tensor([1e3, 1e3, 60.0], dtype=torch.float64)
    learner = train(linear_learner(parts=parts), generator)
    model = EnhancedModel(lambda s, a: s * a.sum(), learner, action_scale=30.0, output_scale=scale)
    state = torch.randn(N_S, generator=generator, dtype=torch.float64)
    weight = torch.tensor([0.3, 0.0, 2.0], dtype=torch.float64)
    at, there = (0.05 * torch.randn(2, N_A, generator=generator, dtype=torch.float64)).unbind()
    v = model.variance(state, at, weight)
    step = there - at
    expanded = v.value + v.gradient @ step + 0.5 * step @ v.curvature @ step
    exact = (weight * model.predict(state, there).variance).sum()
    torch.testing.assert_close(expanded, exact, rtol=1e-9, atol=0)
    # at rest: no variance, no slope; the curvature is the same
    rest = model.variance(state, torch.zeros_like(at), weight)
    assert float(rest.value) == 0
    assert float(rest.gradient.abs().max()) == 0
    torch.testing.assert_close(rest.curvature, v.curvature)


def test_bank_speaks_with_the_voice_of_its_leader(generator: torch.Generator) -> None:
    bank = ModelBank(linear_learner, 2)
    train(bank, generator, 10)
    x, weight = torch.ones(N_S + N_A, dtype=torch.float64), torch.ones(N_OUT, dtype=torch.float64)
    for ours, theirs in zip(
        action_variance(bank, x, N_A, weight), action_variance(bank.working, x, N_A, weight), strict=True
    ):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("name", [n for n in HAND_LEARNERS if n not in ("model alone", "MLP")])
def test_other_learners_by_differentiation(name: str, generator: torch.Generator) -> None:
    learner = train(make_learner(name, N_S, N_A, 20), generator)
    x = torch.randn(N_S + N_A, generator=generator, dtype=torch.float64)
    weight = torch.linspace(0.5, 1.5, 6, dtype=torch.float64)
    v = action_variance(learner, x, N_A, weight)

    def value(d: torch.Tensor) -> torch.Tensor:
        moved = torch.cat([x[:N_S], x[N_S:] + d])
        return (weight * learner.predict(moved).variance).sum().detach()

    torch.testing.assert_close(v.value, value(torch.zeros(N_A, dtype=torch.float64)))
    assert float(torch.linalg.eigvalsh(v.curvature).min()) > -1e-12
    h = 1e-5
    basis = h * torch.eye(N_A, dtype=torch.float64)
    slope = torch.stack([(value(d) - value(-d)) / (2 * h) for d in basis])
    torch.testing.assert_close(v.gradient, slope, rtol=1e-4, atol=1e-7)


def test_curvature_is_the_convex_part(generator: torch.Generator) -> None:
    """Between two samples the variance of a squared exponential is a hill: no curvature along it."""
    learner = SparseOnlineGP(
        2, 1, kernel=SquaredExponential(2), noise_variance=1e-4, parts=(), standardize=False
    )
    learner.update(
        torch.tensor([[0.0, -1.5], [0.0, 1.5]], dtype=torch.float64), torch.zeros(2, 1, dtype=torch.float64)
    )
    weight = torch.ones(1, dtype=torch.float64)
    hill = action_variance(learner, torch.zeros(2, dtype=torch.float64), 1, weight)
    assert float(hill.curvature) == 0.0
    valley = action_variance(learner, torch.tensor([0.0, 1.5], dtype=torch.float64), 1, weight)
    assert float(valley.curvature) > 0.1


@pytest.mark.parametrize("learner", [ZeroResidual, ReplayMLP])
def test_learner_as_sure_of_one_action_as_of_another_is_refused(learner: type) -> None:
    x, weight = torch.ones(N_S + N_A, dtype=torch.float64), torch.ones(N_OUT, dtype=torch.float64)
    with pytest.raises(ParameterError, match=learner.__name__):
        action_variance(learner(N_S + N_A, N_OUT), x, N_A, weight)


def test_the_law_of_a_measurement_has_the_noise_too():
    torch.manual_seed(0)
    learner = SparseOnlineGP(2, 1, noise_variance=0.04, standardize=False, parts=[])
    ekm = EnhancedModel(lambda s, a: 2 * a, learner)
    state, action = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    ekm.update(state, action, torch.tensor([2.3], dtype=torch.float64))
    model, measured = ekm.predict(state, action), ekm.predict(state, action, observation=True)
    assert torch.allclose(measured.mean, model.mean)
    assert torch.allclose(measured.variance - model.variance, torch.tensor([0.04], dtype=torch.float64))


@pytest.mark.parametrize(
    ("action", "increment", "name"), [([1.0], None, "action"), (None, [1.0], "increment")]
)
def test_what_is_no_tensor_is_named(action, increment, name):
    ekm = EnhancedModel(lambda s, a: 2 * a, SparseOnlineGP(2, 1))
    one = torch.ones(1)
    with pytest.raises(ParameterError, match=name):
        ekm.update(one, action or one, increment or one)
