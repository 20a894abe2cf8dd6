"""Systems that change and change back."""

from __future__ import annotations

import copy

import pytest
import torch
from as_published import share_left as left

from torch_ekm.residual import MixtureResidual, SparseOnlineGP, default_learner


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
    with_it, without = left(learner, x[500:], y[500:]), left(forgetful, x[500:], y[500:])
    assert with_it < 0.3
    assert without > 2.0 * with_it


def test_what_is_known_travels_with_the_learner():
    learner, other = default_learner(3, 2), default_learner(3, 2)
    x, y = there_and_back(1)
    learner.update(x[:450], y[:450])
    other.load_state_dict(learner.state_dict())
    ends = [left(one, x[450:], y[450:]) for one in (learner, copy.deepcopy(learner), other)]
    assert ends[0] == pytest.approx(ends[1], rel=1e-6) == pytest.approx(ends[2], rel=1e-6)


def test_after_a_reset_no_regime_is_known():
    learner = default_learner(3, 2)
    x, y = there_and_back(1)
    learner.update(x[:400], y[:400])
    assert learner.returns is not None
    assert learner.returns.known["evidence"]
    learner.reset()
    assert not learner.returns.known["evidence"]


def test_without_a_learner_that_notes_changes_nothing_is_kept():
    assert MixtureResidual(SparseOnlineGP(2, 1, parts=[])).returns is None
    assert default_learner(2, 1, batch_shape=(2,)).returns is None
