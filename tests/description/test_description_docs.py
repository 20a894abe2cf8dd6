"""The hand that docs/tutorials/your_own_hand.md describes, and what docs/how_to learns from recordings."""

import dataclasses
import re
from pathlib import Path

import pytest
import torch

from torch_ekm.description import load_hand
from torch_ekm.kinematics import ActuationMap, HandKinematics

DOCS = Path(__file__).parents[2] / "docs"


def block(page: str, containing: str) -> str:
    """The one block of Python with this text, whether the test of all pages runs it or not."""
    path = DOCS / page
    code = r"^```(?:python|\{code-block\} python\n:class: skip)\n(.*?)^```"
    blocks = re.findall(code, path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    (found,) = [one for one in blocks if containing in one]
    return found


def test_the_hand_of_the_tutorial_loads_and_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for part in ("LINK = ", "[[actuators]]"):
        exec(block("tutorials/your_own_hand.md", part), {"Path": Path})
    hand = load_hand("gripper.urdf")
    assert hand.base_link == "hand"
    assert [shape.kind for shape in hand.urdf.link("left_far").collisions] == ["cylinder", "sphere"]
    q = ActuationMap(hand).joints(torch.tensor([1.14, 0.57], dtype=torch.float64))
    # 0.2 q_0 = t, 0.1 q_1 = 0.8 t, q_0 + 0.8 q_1 = a - t / 10
    left = torch.tensor([1.0, 1.6], dtype=torch.float64) * 1.14 / 2.3
    torch.testing.assert_close(q, torch.cat([left, 0.5 * left]))
    base = torch.tensor([-0.03, 0.0, 0.0], dtype=torch.float64)
    along = torch.tensor([torch.sin(q[0]), torch.cos(q[0]), 0.0], dtype=torch.float64)  # closes towards +x
    tip = HandKinematics(hand)(q).of("left_far")[:3, 3]
    torch.testing.assert_close(tip, base + 0.04 * along, atol=1e-6, rtol=0)  # 1.5708 is half of pi


def test_figures_are_learned_from_recordings_as_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    pytest.importorskip("sapien")
    from torch_ekm.description import write_transmission
    from torch_ekm.plant import RecordingPlant, TrialLog
    from torch_ekm.simulation import SimulatedHand

    monkeypatch.chdir(tmp_path)
    described = load_hand("planar_two_finger")
    arms = 1.3 * described.actuation_jacobian
    write_transmission(dataclasses.replace(described, actuation_jacobian=arms), "my_hand.transmission.toml")
    plant = RecordingPlant(SimulatedHand("planar_two_finger", "can"))
    log = TrialLog("recordings", {})
    draw = torch.Generator().manual_seed(0)
    for trial in range(2):
        plant.reset(trial)
        for _ in range(6):
            plant.command(0.06 * torch.rand(2, generator=draw, dtype=torch.float64) - 0.03)
        log.write(trial, plant.trajectory)
    plant.close()
    names: dict = {}
    exec(block("how_to/drive_a_real_hand.md", "figures.learn("), names)
    assert "spring of left_0" in capsys.readouterr().out
    assert int(names["figures"].count) > 8
    assert (tmp_path / "my_hand.ekm").is_file()
