"""The page on the simulator names every way in which a plant can differ from its description."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from torch_ekm.simulation import PRESETS, PlantParameters

PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "simulator.md"


def test_every_field_and_preset_is_named():
    text = PAGE.read_text(encoding="utf-8")
    for name in (*(item.name for item in dataclasses.fields(PlantParameters)), *PRESETS):
        assert f"`{name}`" in text, name
