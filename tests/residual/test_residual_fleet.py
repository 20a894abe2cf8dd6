"""A fleet of learners does what each of them does alone."""

from __future__ import annotations

import pytest
import torch
from as_published import sogp

from torch_ekm.exceptions import ParameterError, ShapeError
from torch_ekm.residual import (
    KRLSTracker,
    LearnerFleet,
    SparseOnlineGP,
    SquaredExponential,
)


def stream(n: int, *shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(n, *shape, 3, generator=generator, dtype=torch.float64)
    return x, torch.sin(x[..., :2] + x[..., 2:])


def test_fleet_equals_single_learners_with_masks() -> None:
    x, y = stream(40, 2, 3)
    mask = torch.rand(40, 2, 3, generator=torch.Generator().manual_seed(2)) < 0.7
    fleet = LearnerFleet(KRLSTracker, 3, 2, batch_shape=(2, 3), capacity=10)
    report = fleet.update(x, y, mask)
    query = stream(7, 2, 3)[0]
    mean, law, slope = fleet(query), fleet.predict(query), fleet.linearize(query)[1]
    for i in range(2):
        for j in range(3):
            alone = KRLSTracker(3, 2, capacity=10)
            own = alone.update(x[:, i, j], y[:, i, j], mask[:, i, j])
            at = query[:, i, j]
            torch.testing.assert_close(mean[:, i, j], alone(at), rtol=0, atol=1e-10)
            torch.testing.assert_close(law.stddev[:, i, j], alone.predict(at).stddev, rtol=0, atol=1e-10)
            torch.testing.assert_close(slope[:, i, j], alone.linearize(at)[1], rtol=0, atol=1e-10)
            assert torch.equal(report.event[:, i, j], own.event)
            assert torch.equal(fleet[i, j](at), alone(at))


def test_fleet_equals_the_learner_that_is_one_itself() -> None:
    x, y = stream(30, 4)
    slow = LearnerFleet(sogp, 3, 2, batch_shape=(4,), capacity=8)
    fast = sogp(3, 2, capacity=8, batch_shape=(4,))
    for learner in (slow, fast):
        learner.update(x, y)
    torch.testing.assert_close(slow(x), fast(x), rtol=0, atol=1e-10)
    torch.testing.assert_close(slow(x[0, 0]), fast(x[0, 0]), rtol=0, atol=1e-10)  # one query for all
    assert isinstance(slow.predictive(x[0]), torch.distributions.Normal)


def test_each_learner_has_a_kernel_of_its_own() -> None:
    kernel = SquaredExponential(3)
    fleet = LearnerFleet(SparseOnlineGP, 3, 2, batch_shape=(2,), capacity=8, kernel=kernel)
    fleet[0].kernel.log_lengthscale.add_(1.0)
    assert not torch.equal(fleet[0].kernel.lengthscale, fleet[1].kernel.lengthscale)


def test_wrong_sizes() -> None:
    fleet = LearnerFleet(KRLSTracker, 3, 2, batch_shape=(2,), capacity=4)
    with pytest.raises(ShapeError, match="2, 3"):
        fleet.update(torch.zeros(3, 3), torch.zeros(3, 2))
    with pytest.raises(ParameterError, match="LearnerFleet"):
        KRLSTracker(3, 2, batch_shape=(2,))
    for index in (2, (0, 0), -3):
        with pytest.raises(ParameterError, match="one place"):
            fleet[index]
    with pytest.raises(ParameterError, match="single learners of 3 inputs"):
        LearnerFleet(lambda *_, **__: KRLSTracker(4, 2), 3, 2, batch_shape=(2,))
    with pytest.raises(ParameterError, match="capacity"):
        LearnerFleet(KRLSTracker, 3, 2, batch_shape=(2,), capacity=0)
