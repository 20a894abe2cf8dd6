"""Wiring files for tests."""

import math
import re
from pathlib import Path

import torch

DEG = math.pi / 180

T42 = """\
[hand]
driver = "dynamixel"
description = "yale_t42"

[bus]
port = "PORT"
baud = 1000000

[[motors]]
name = "right"
id = 2
sign = -1
zero = 3000

[[motors]]
name = "left"
id = 1
zero = 1000

[limits]
increment_deg = 20
rate_deg = 200
still_for = 0.05
timeout = 0.5
"""


def radians(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def of_page(driver: str) -> str:
    """The wiring file for a driver that the how-to shows."""
    page = Path(__file__).parents[2] / "docs" / "how_to" / "drive_over_yarp_or_ros2.md"
    shown = re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    (found,) = (text for text in shown if f'driver = "{driver}"' in text)
    return found


def write(folder: Path, text: str = T42, port: str = "none", **changes: str) -> Path:
    """A wiring file; ``changes`` of its text, one after the other: ``a="old|new"``."""
    for change in changes.values():
        old, new = change.split("|")
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "my_hand.toml"
    path.write_text(text.replace("PORT", port))
    return path
