"""GPyTorch behind the contract of learners."""

import pytest
import torch


def test_gpytorch_learns(monkeypatch: pytest.MonkeyPatch) -> None:
    import gpytorch_svgp

    monkeypatch.setattr(gpytorch_svgp, "_RATE", 0.05)
    x = torch.linspace(-1, 1, 60, dtype=torch.float64).repeat(3)[:, None]
    learner = gpytorch_svgp.GPyTorchSVGP(1, 2, inducing=8)
    assert not learner(x).any()
    y = torch.cat([x, -x], dim=1)
    learner.update(x, y)
    assert (learner(x) - y).square().mean() < 0.3 * y.square().mean()
    law = learner.predict(x, observation=True)
    assert law.mean.shape == law.stddev.shape == y.shape
