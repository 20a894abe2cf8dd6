"""What the documentation says of the presets is what they are."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from torch_ekm.simulation import PlantParameters
from torch_ekm.simulation.preset_table import preset_table

DOCUMENT = Path(__file__).parents[2] / "docs" / "simulation.md"


def test_the_table_in_the_documentation_is_up_to_date():
    """If not: python -m torch_ekm.simulation.preset_table."""
    assert preset_table() in DOCUMENT.read_text(encoding="utf-8")


def test_every_disturbance_is_in_the_documentation():
    text = DOCUMENT.read_text(encoding="utf-8").split("### Presets")[0]
    for item in dataclasses.fields(PlantParameters):
        assert f"`{item.name}`" in text, item.name


def test_figures_are_shown_in_readable_units():
    lines = {line.split("`")[1]: line for line in preset_table().splitlines()[2:]}
    assert len(lines) == len(dataclasses.fields(PlantParameters))
    assert lines["link_weight"].startswith("| `link_weight` |  | no | yes |")
    assert lines["stuck_joints"].endswith("| none | . | . | index_3 |")
    shift = PlantParameters.nominal_mismatch().com_shift
    assert f"| {', '.join(f'{1e3 * x:g}' for x in shift)} |" in lines["com_shift"]
    assert lines["backlash"].split("|")[2].strip() == "deg"
