"""A learner inside of other libraries' optimal control."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

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
