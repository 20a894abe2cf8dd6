"""docs/your_own_hand.md: its example works as printed, and it documents every key."""

from __future__ import annotations

import dataclasses
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


def block(page: str, language: str, containing: str = "") -> str:
    blocks = re.finditer(rf"```{language}\n(.*?)```", page, re.DOTALL)
    found = next((match for match in blocks if containing in match.group(1)), None)
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


def test_the_printed_calibration_runs(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("sapien")
    from torch_ekm.description import write_transmission
    from torch_ekm.plant import RecordingPlant, TrialLog
    from torch_ekm.simulation import SimulatedHand

    monkeypatch.chdir(tmp_path)
    described = load_hand("planar_two_finger")
    springs = described.spring_stiffness * [1.3, 0.8, 0.75, 1.25]
    write_transmission(dataclasses.replace(described, spring_stiffness=springs), "my_hand.transmission.toml")
    plant = RecordingPlant(SimulatedHand("planar_two_finger", "can"))
    log = TrialLog("recordings", {})
    draw = torch.Generator().manual_seed(0)
    for trial in range(2):
        plant.reset(trial)
        for _ in range(3):
            plant.command(0.06 * torch.rand(2, generator=draw, dtype=torch.float64) - 0.03)
        log.write(trial, plant.trajectory)
    plant.close()
    names: dict = {}
    exec(block(page, "python", "calibrate"), names)
    assert "spring of left_0" in capsys.readouterr().out
    found = names["hand"].spring_stiffness
    assert (abs(found / described.spring_stiffness - 1) < 0.1).all()
