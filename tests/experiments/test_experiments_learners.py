"""Learners in the units of a grasp."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from torch_ekm import residual
from torch_ekm._recorded import describe, differences
from torch_ekm.experiments.learners import COMPARED, LEARNERS, N_OUT, make_learner

PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "choose_a_learner.md"

N_S, N_A, ZONE = 4, 3, 0.65  # dead zone of 1.3 deg in units of 2 deg


def motion_left(name: str) -> float:
    """``|J a + g(s, a)| / |J a|`` for commands inside the dead zone, where nothing moves: best is 0."""
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(N_OUT, N_A, generator=generator, dtype=torch.float64)
    along = torch.tensor([1.0, 0.7, -0.6], dtype=torch.float64)  # the direction of a turn
    state = torch.zeros(N_S, dtype=torch.float64)
    learner = make_learner(name, N_S, N_A, 60)

    def residual(action: torch.Tensor) -> torch.Tensor:
        moved = action.sign() * (action.abs() - ZONE).clamp_min(0)
        return J @ (moved - action)

    for size in (3 * torch.rand(60, generator=generator, dtype=torch.float64)).tolist():
        learner.update(torch.cat([state, size * along]), residual(size * along))
    inside = [0.3 * along, 0.5 * along]
    left = [J @ a + learner(torch.cat([state, a])) for a in inside]
    return float(torch.stack(left).norm() / torch.stack([J @ a for a in inside]).norm())


def test_one_learner_takes_up_a_dead_zone_and_the_default_leaves_it_to_the_servo_inverse() -> None:
    assert motion_left("rbf") < 0.35
    assert motion_left("action-linear") > 0.5  # a mean that is linear in the action cannot


@pytest.mark.skipif(not PAGE.is_file(), reason="the documentation is not part of this installation")
def test_the_page_has_the_call_of_each_name() -> None:
    section = PAGE.read_text(encoding="utf-8").split("## Names in")[1].split("\n## ")[0]
    rows = [row.strip("| ").split(" | ") for row in section.splitlines() if "`" in row and row[0] == "|"]
    calls = dict(
        pair
        for names, text in rows
        for pair in zip(names.split(", "), re.findall("`(.*?)`", text), strict=False)
    )
    assert calls.keys() == {*COMPARED}
    del calls["SOGP mixture"]  # in words
    for name, call in calls.items():
        if call.startswith("parts="):
            call = f"SparseOnlineGP(d, m, kernel=SquaredExponential(d), {call})"
        if "parts=" in call:
            call = f"{call[:-1]}, standardize=False)"
        written = describe(eval(call, {**vars(residual), "d": 3, "m": 2}))
        made = describe(LEARNERS[name](3, 2))
        assert made["class"] == written["class"]
        assert not differences(made, written, {}), name
