"""A learner inside of other libraries' optimal control."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ekm import SparseOnlineGP
from torch_ekm.exceptions import ShapeError
from torch_ekm.interop import AcadosResidual

EXAMPLES = Path(__file__).parents[2] / "examples"


def load(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_learner_takes_cost_off_residual_mpc(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("casadi", reason="extra 'interop'")
    alone, corrected = load("residual_mpc").main(["--quick"])
    assert corrected.cost < 0.7 * alone.cost
    assert corrected.distance < 0.7 * alone.distance
    assert int(corrected.learner.posterior.count) > 5
    assert "with the learner" in capsys.readouterr().out


def test_what_l4acados_asks_of_a_residual_model() -> None:
    torch.manual_seed(0)
    learner = SparseOnlineGP(2, 3, capacity=10)
    x = torch.rand(60, 2, dtype=torch.float64)
    learner.update(x, torch.stack([x[:, 0], x[:, 1].sin(), x.prod(-1)], dim=-1))
    residual, stages = AcadosResidual(learner, columns=[3, 1]), np.random.default_rng(0).random((7, 4))
    value, jacobian = residual.value_and_jacobian(stages)
    assert (value.shape, jacobian.shape) == ((7, 3), (3, 7, 4))
    step = 1e-6
    for column in range(4):
        moved = stages.copy()
        moved[:, column] += step
        difference = (residual.evaluate(moved) - value) / step
        assert np.allclose(jacobian[:, :, column], difference.T, atol=1e-4)
    assert np.array_equal(residual.jacobian(stages), jacobian)
    assert not jacobian[..., [0, 2]].any()
    with pytest.raises(ShapeError, match="columns"):
        AcadosResidual(learner, columns=[0])
