"""docs/your_own_hand.md: its example works as printed, and it documents every key."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from torch_ekm.description import load_hand, transmission
from torch_ekm.kinematics import ActuationMap, HandKinematics

PAGE = Path(__file__).parents[2] / "docs" / "your_own_hand.md"


@pytest.fixture
def page() -> str:
    if not PAGE.is_file():
        pytest.skip("the documentation is not part of this installation")
    return PAGE.read_text(encoding="utf-8")


def block(page: str, language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", page, re.DOTALL)
    assert found is not None
    return found.group(1)


def test_the_printed_example_loads_and_moves(page: str, tmp_path: Path) -> None:
    (tmp_path / "finger.urdf").write_text(block(page, "xml"))
    (tmp_path / "finger.transmission.toml").write_text(block(page, "toml"))
    hand = load_hand(tmp_path / "finger.urdf")
    assert hand.base_link == "base"
    assert [shape.kind for shape in hand.urdf.link("distal").collisions] == ["capsule"]
    q = ActuationMap(hand).joints(torch.tensor([1.14], dtype=torch.float64))
    torch.testing.assert_close(q, torch.tensor([0.5, 0.8], dtype=torch.float64))
    tip = HandKinematics(hand)(q).of("distal")[:3, 3]
    expected = 0.04 * torch.tensor([torch.cos(q[0]), torch.sin(q[0]), 0.0], dtype=torch.float64)
    torch.testing.assert_close(tip, expected)


def test_every_key_is_documented(page: str) -> None:
    keys = {*transmission.HAND, *transmission.JOINT, *transmission.ACTUATOR, *transmission.COUPLING}
    keys |= {*transmission.PAD, *transmission.HALL}
    missing = [key for key in sorted(keys) if f"`{key}`" not in page]
    assert not missing
    for table in transmission.TABLES:
        assert re.search(rf"`\[+{table}\]+`", page), table
