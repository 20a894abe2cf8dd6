"""What outliers cost a learner, and how it recovers after a change."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch

from torch_ekm.residual import ResidualLearner
from torch_ekm.typing import Tensor


class Stream(NamedTuple):
    """Training samples in the order of arrival, and a held-out test set."""

    name: str
    x: Tensor
    y: Tensor
    x_test: Tensor
    y_test: Tensor


def recovery_after_change(
    factory: Callable[[], ResidualLearner],
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
    test: tuple[Tensor, Tensor],
    samples: int = 50,
) -> float:
    """Error after an abrupt change over that of a fresh learner, both after the same new samples."""
    old, fresh = factory(), factory()
    old.update(*before)
    x, y = after[0][:samples], after[1][:samples]
    old.update(x, y)
    fresh.update(x, y)
    rms = [float((learner(test[0]) - test[1]).square().mean().sqrt()) for learner in (old, fresh)]
    return rms[0] / rms[1]


def outlier_cost(factory: Callable[[], ResidualLearner], stream: Stream) -> float:
    """Test RMSE with a tenth of the targets thrown off by 20 deviations, over that without."""
    generator = torch.Generator().manual_seed(0)
    hit = torch.rand(len(stream.y), 1, generator=generator) < 0.1
    sign = torch.randn(stream.y.shape, generator=generator, dtype=stream.y.dtype).sign()
    clean, dirty = factory(), factory()
    clean.update(stream.x, stream.y)
    dirty.update(stream.x, stream.y + hit * 20.0 * sign)
    errors = [(learner(stream.x_test) - stream.y_test).square().mean().sqrt() for learner in (clean, dirty)]
    return float(errors[1] / errors[0])
