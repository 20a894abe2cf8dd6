"""The examples of README do what the text around them says."""

import math
import re
from pathlib import Path
from typing import Any

import torch

README = Path(__file__).parents[1] / "README.md"


def run(mark: str) -> tuple[str, dict[str, Any]]:
    """The one block of python that contains ``mark``, and its variables after it ran."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    (block,) = [text for text in blocks if mark in text]
    names: dict[str, Any] = {}
    exec(compile(block, "README.md", "exec"), names)
    return block, names


def test_an_enhanced_model_around_a_model_of_ones_own() -> None:
    torch.manual_seed(0)
    _, names = run("default_learner(4, 2)")
    ekm, f = names["ekm"], names["f"]
    state, action = torch.rand(100, 2), torch.randn(100, 2)
    model = torch.stack([f(s, a) for s, a in zip(state, action, strict=True)])
    truth = model * 1.3 + 0.1
    learned = torch.stack([ekm.linearize(s, a)[0] for s, a in zip(state, action, strict=True)])
    assert (learned - truth).square().mean() < 0.1 * (model - truth).square().mean()
    assert names["jacobian"].shape == (2, 2)


def test_the_e_km_turns_the_box_in_at_most_twenty_lines(capsys) -> None:
    block, names = run("ClosedLoop(")
    assert len(block.splitlines()) <= 20
    result, start = names["result"], names["seen"]
    assert capsys.readouterr().out.startswith("reached")
    assert result.errors[-1] <= math.radians(0.25)
    assert all(step.report is not None for step in result.steps)
    turned = result.stop.final.state.minus(start.state)[-3:]
    assert abs(math.degrees(turned @ names["plant"].rotation_axis) - 20) < 0.5
    true = result.stop.final.truth  # and not only as the noisy sensors saw it
    turned = type(start.state)(true.q, true.position, true.rotation).minus(start.state)[-3:]
    assert abs(math.degrees(turned @ names["plant"].rotation_axis) - 20) < 1.0


def test_it_is_short() -> None:
    """One page: at most 80 lines of 120 characters, and 700 words."""
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80
    assert len(text.split()) <= 700
    assert max(map(len, text.splitlines())) <= 120
