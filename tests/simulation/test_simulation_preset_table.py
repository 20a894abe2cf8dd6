"""What the documentation says of the presets is what they are."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

from torch_ekm.simulation import PRESETS, PlantParameters, preset

DOCUMENT = Path(__file__).parents[2] / "docs" / "simulation.md"

_DEG = math.pi / 180
_ANGLES = ("tendon_elongation", "actuator_bias", "actuator_error", "dead_zone", "threshold", "backlash")
_SHOWN_AS = {name: (1 / _DEG, "deg") for name in (*_ANGLES, "joint_noise", "rotation_noise")}
_SHOWN_AS |= {name: (1e3, "mm") for name in ("com_shift", "position_noise")}
_SHOWN_AS |= {name: (1.0, "N") for name in ("force_noise", "force_offset", "force_hysteresis", "force_range")}
_SHOWN_AS |= {"tendon_creep": (1 / _DEG, "deg/(N m s)"), "latency": (1.0, "s")}


def preset_table() -> str:
    """All figures of all presets as a Markdown table, with "." for what is as in "none"."""
    lines = [f"| parameter | unit | {' | '.join(PRESETS)} |", "|---" * (2 + len(PRESETS)) + "|"]
    for item in dataclasses.fields(PlantParameters):
        name = item.name
        factor, unit = _SHOWN_AS.get(name, (1.0, ""))
        values = [_shown(getattr(parameters, name), factor) for parameters in PRESETS.values()]
        values[1:] = ["." if value == values[0] else value for value in values[1:]]
        lines.append(f"| `{name}` | {unit} | {' | '.join(values)} |")
    return "\n".join(lines)


def _shown(value: object, factor: float) -> str:
    if isinstance(value, tuple):
        return ", ".join(_shown(entry, factor) for entry in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{factor * value:.3g}" if isinstance(value, int | float) else str(value)


def test_the_table_in_the_documentation_is_up_to_date():
    """If not, this prints it: python tests/simulation/test_simulation_preset_table.py."""
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
    shift = preset("nominal").com_shift
    assert f"| {', '.join(f'{1e3 * x:g}' for x in shift)} |" in lines["com_shift"]
    assert lines["backlash"].split("|")[2].strip() == "deg"


if __name__ == "__main__":
    print(preset_table())
