"""The bank of models: it recognises what it knows, starts new models, and is a learner like any other."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch

from torch_ekm.enhanced import EnhancedModel
from torch_ekm.exceptions import ParameterError
from torch_ekm.object_memory import ModelBank
from torch_ekm.object_memory.model_bank import discount
from torch_ekm.residual import ActionLinearKernel, SparseOnlineGP, SquaredExponential, WindowGP
from torch_ekm.testing import check_residual_learner

N_S, N_A, N_OUT = 3, 2, 2
NOISE = 0.05


def learner(**options: Any) -> SparseOnlineGP:
    kernel = ActionLinearKernel(N_S + N_A, N_A, state_kernel=SquaredExponential(N_S, lengthscale=10.0))
    chosen = {"capacity": 20, "kernel": kernel, "noise_variance": NOISE**2, "parts": (), "standardize": False}
    return SparseOnlineGP(N_S + N_A, N_OUT, **{**chosen, **options})


class World:
    """Objects that answer the same action differently: ``y = (common + own_k) a``."""

    def __init__(self, n_objects: int, seed: int, spread: float = 0.5) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.common = torch.tensor([[1.0, 0.3], [-0.4, 0.8]], dtype=torch.float64)
        self.own = spread * self._randn(n_objects, N_OUT, N_A)

    def episode(self, k: int, n: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
        x = self._randn(n, N_S + N_A)
        y = x[:, N_S:] @ (self.common + self.own[k]).mT + NOISE * self._randn(n, N_OUT)
        return x, y

    def _randn(self, *shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)


def feed(target: torch.nn.Module, x: torch.Tensor, y: torch.Tensor) -> list[float]:
    """Errors of the predictions made before each sample is learned."""
    errors = []
    for x_t, y_t in zip(x, y, strict=True):
        errors.append(float((target(x_t) - y_t).norm()))
        target.update(x_t, y_t)
    return errors


def run(
    n_objects: int = 4, visits: int = 5, spread: float = 0.5
) -> tuple[ModelBank, list, dict[str, list[float]]]:
    """A random sequence of objects; where each episode went, and everybody's errors after first visits."""
    world = World(n_objects, seed=3, spread=spread)
    order = torch.randperm(n_objects * visits, generator=world.generator) % n_objects
    bank, one = ModelBank(learner, 8), learner()
    labelled = [learner() for _ in range(n_objects)]
    placed: list[tuple[int, int | None]] = []
    errors: dict[str, list[float]] = {"bank": [], "labelled": [], "one": []}
    seen = [0] * n_objects
    for k in order.tolist():
        slot = bank.begin()
        if placed:
            placed[-1] = (placed[-1][0], slot)
        x, y = world.episode(k)
        found = {"bank": feed(bank, x, y), "labelled": feed(labelled[k], x, y), "one": feed(one, x, y)}
        seen[k] += 1
        if seen[k] > 1:
            for name, values in found.items():
                errors[name] += values[2:]  # the first two tell the bank which object this is
        placed.append((k, None))
    placed[-1] = (placed[-1][0], bank.begin())
    return bank, placed, errors


@pytest.mark.usefixtures("unchecked")
def test_is_a_residual_learner() -> None:
    check_residual_learner(lambda **options: ModelBank(lambda: learner(**options), 3))


def test_objects_are_told_apart_without_labels() -> None:
    bank, placed, _ = run()
    assert bank.n_models == 4
    home: dict[int, int | None] = {}
    for k, slot in placed:
        assert home.setdefault(k, slot) == slot, "an object went to two models"
    assert len(set(home.values())) == 4, "two objects share a model"


def test_bank_predicts_like_labelled_models_and_better_than_one() -> None:
    _, _, errors = run()
    mean = {name: sum(values) / len(values) for name, values in errors.items()}
    assert mean["bank"] < 1.1 * mean["labelled"]
    assert mean["bank"] < 0.5 * mean["one"]


def test_bank_is_no_worse_than_one_model_where_objects_are_alike() -> None:
    """They feel different, so each has its model, but they answer alike: what is common knows more."""
    world, one = World(1, seed=3), learner()
    bank = ModelBank(learner, 8, temperature=0.1, signature_features=1)
    ours, theirs = [], []
    for episode in range(30):
        place = episode % 5
        bank.begin(torch.tensor([10.0 * place], dtype=torch.float64) + 0.1 * world._randn(1))
        x, y = world.episode(0, n=8)
        ours += feed(bank, x, y)
        theirs += feed(one, x, y)
    assert bank.n_models == 5
    assert sum(ours) < 1.03 * sum(theirs)  # the leader alone: 1.09 times


def test_bank_mixes_leader_and_common_learner() -> None:
    bank, _, _ = run(n_objects=2, visits=2, spread=0.2)
    bank.begin()
    feed(bank, *World(2, seed=3, spread=0.2).episode(1, n=4))
    x = torch.full((N_S + N_A,), 0.7, dtype=torch.float64)
    p, ours, theirs = float(bank.lead.sigmoid()), bank.working, bank.common
    assert 0.55 < p < 0.999
    torch.testing.assert_close(bank(x), p * ours(x) + (1 - p) * theirs(x))
    torch.testing.assert_close(bank.linearize(x)[1], torch.func.jacrev(bank)(x))
    draws = torch.Generator().manual_seed(0)
    which = torch.rand(200_000, 1, generator=draws) < p
    laws = [g.predict(x) for g in (ours, theirs)]
    y = torch.where(which, laws[0].mean, laws[1].mean) + torch.where(
        which, laws[0].stddev, laws[1].stddev
    ) * torch.randn(200_000, N_OUT, generator=draws, dtype=torch.float64)
    torch.testing.assert_close(bank.predict(x).stddev, y.std(0), rtol=0.01, atol=0)


def test_familiar_object_is_taken_up_within_two_samples() -> None:
    world, bank = World(3, seed=5), ModelBank(learner, 8)
    for k in (0, 1, 2):
        bank.begin()
        feed(bank, *world.episode(k))
    bank.begin()
    x, y = world.episode(1)
    feed(bank, x[:2], y[:2])
    assert int(bank.leader) == 1
    assert bank.posterior[1] > 0.9
    torch.testing.assert_close(bank.posterior.sum(), torch.tensor(1.0, dtype=torch.float64))


def test_new_object_starts_from_what_is_common() -> None:
    world, bank = World(4, seed=7, spread=0.1), ModelBank(learner, 8)
    for k in (0, 1, 2, 0, 1, 2):
        bank.begin()
        feed(bank, *world.episode(k))
    bank.begin()
    x, y = world.episode(3)
    feed(bank, x[:1], y[:1])
    fresh = learner()
    feed(fresh, x[:1], y[:1])
    test_x, test_y = world.episode(3, 50)
    assert (bank(test_x) - test_y).norm() < 0.7 * (fresh(test_x) - test_y).norm()


def test_full_bank_makes_no_more_models() -> None:
    world, bank = World(4, seed=2), ModelBank(learner, 2)
    for k in (0, 1, 2, 3, 0):
        bank.begin()
        feed(bank, *world.episode(k))
    bank.begin()
    assert bank.n_models == 2
    assert float(bank.posterior[-1]) == 0.0


def test_short_episode_leaves_no_trace() -> None:
    world, bank = World(1, seed=0), ModelBank(learner, 4)
    feed(bank, *world.episode(0, 2))
    assert bank.begin() is None
    assert bank.n_models == 0


def test_state_survives_a_reload_in_mid_episode() -> None:
    world, bank = World(2, seed=1), ModelBank(learner, 4)
    for k in (0, 1):
        bank.begin()
        feed(bank, *world.episode(k))
    bank.begin()
    x, y = world.episode(0)
    feed(bank, x[:5], y[:5])
    other = ModelBank(learner, 4)
    other.load_state_dict(bank.state_dict())
    twin = copy.deepcopy(bank)
    for one in (bank, other, twin):
        feed(one, x[5:], y[5:])
    for one in (other, twin):
        torch.testing.assert_close(one(x), bank(x), rtol=0, atol=0)
        assert one.begin() == int(bank.leader)


def test_discount_keeps_the_mean_and_widens_the_variance() -> None:
    world = World(1, seed=0)
    # a state kernel this long is linear regression: all uncertainty is of data, none of the basis
    kernel = ActionLinearKernel(N_S + N_A, N_A, state_kernel=SquaredExponential(N_S, lengthscale=1e3))
    model = SparseOnlineGP(
        N_S + N_A, N_OUT, capacity=20, kernel=kernel, noise_variance=NOISE**2, parts=(), standardize=False
    )
    feed(model, *world.episode(0, 200))
    x, _ = world.episode(0, 30)
    before = model.predict(x)
    discount(model, 0.1)
    after = model.predict(x)
    assert (after.mean - before.mean).norm() < 0.01 * before.mean.norm()
    ratio = float((after.variance / before.variance).median())
    assert 7 < ratio < 11
    window = WindowGP(N_S + N_A, N_OUT)
    discount(window, 0.1)  # nothing to discount: left as it is


def test_bank_serves_as_the_learner_of_an_enhanced_model() -> None:
    world, bank = World(1, seed=0), ModelBank(learner, 2)
    enhanced = EnhancedModel(lambda state, action: world.common @ action, bank)
    state, action = torch.zeros(N_S, dtype=torch.float64), torch.ones(N_A, dtype=torch.float64)
    assert torch.equal(enhanced(state, action), world.common @ action)
    for _ in range(5):
        enhanced.update(state, action, world.common @ action + 0.5)
    value, jacobian = enhanced.linearize(state, action)
    torch.testing.assert_close(value, world.common @ action + 0.5, atol=0.05, rtol=0)
    assert jacobian.shape == (N_OUT, N_A)


@pytest.mark.parametrize(
    "options",
    [{"models": 0}, {"window": 0}, {"temperature": 1.5}],
)
def test_wrong_figures_are_refused(options: dict) -> None:
    with pytest.raises(ParameterError, match=next(iter(options))):
        ModelBank(learner, **{"models": 2, **options})


def test_fleets_are_refused() -> None:
    with pytest.raises(ParameterError, match="batch_shape"):
        ModelBank(lambda: SparseOnlineGP(3, 2, batch_shape=(2,)), 2)
