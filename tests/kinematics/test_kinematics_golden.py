"""Fingertip poses and one Jacobian of the iCub hand, frozen: a change of any figure or convention shows.

``python tests/kinematics/test_kinematics_golden.py`` writes the file again.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch

from torch_ekm.description import load_hand
from torch_ekm.kinematics import HandKinematics

GOLDEN = Path(__file__).parents[1] / "golden" / "icub_right_kinematics.json"
FINGERS = ("thumb", "index", "middle", "ring", "little")


def compute(q: list[float]) -> dict[str, list]:
    kinematics = HandKinematics(load_hand("icub_right"))
    poses = kinematics(torch.tensor(q, dtype=torch.float64))
    out: dict[str, list] = {f"{finger}_tip": poses.of(f"{finger}_tip").tolist() for finger in FINGERS}
    pad = torch.tensor([0.0165, 0.0062, 0.0], dtype=torch.float64)  # contact point of a pad
    return out | {"jacobian_thumb_pad": kinematics.jacobian(poses, "thumb_3", pad).tolist()}


def test_frozen_figures() -> None:
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    for name, value in compute(golden.pop("q")).items():
        expected = torch.tensor(golden.pop(name), dtype=torch.float64)
        torch.testing.assert_close(torch.tensor(value, dtype=torch.float64), expected, atol=1e-9, rtol=0)
    assert not golden


if __name__ == "__main__":
    hand = load_hand("icub_right")
    fraction = torch.linspace(0.15, 0.85, hand.n_q, dtype=torch.float64).numpy()
    q = (hand.joint_lower + fraction * (hand.joint_upper - hand.joint_lower)).round(6).tolist()
    rounded = json.loads(json.dumps({"q": q} | compute(q)), parse_float=lambda text: round(float(text), 12))
    GOLDEN.write_text(json.dumps(rounded, indent=1) + "\n", encoding="utf-8")
