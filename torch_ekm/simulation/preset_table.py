"""The presets as a table: ``python -m torch_ekm.simulation.preset_table``."""

from __future__ import annotations

import dataclasses
import math

from .parameters import PlantParameters
from .presets import PRESETS

_DEG = math.pi / 180
_ANGLES = ("tendon_elongation", "actuator_bias", "actuator_error", "dead_zone", "threshold", "backlash")
_SHOWN_AS = {name: (1 / _DEG, "deg") for name in (*_ANGLES, "joint_noise", "rotation_noise")}
_SHOWN_AS |= {name: (1e3, "mm") for name in ("com_shift", "position_noise")}
_SHOWN_AS |= {name: (1.0, "N") for name in ("force_noise", "force_offset", "force_hysteresis", "force_range")}
_SHOWN_AS |= {"tendon_creep": (1 / _DEG, "deg/(N m s)"), "latency": (1.0, "s")}


def preset_table() -> str:
    """All figures of all presets as a Markdown table, with "." for what is as in "none"."""
    columns = [make() for make in PRESETS.values()]
    lines = [f"| parameter | unit | {' | '.join(PRESETS)} |", "|---" * (2 + len(PRESETS)) + "|"]
    for item in dataclasses.fields(PlantParameters):
        name = item.name
        factor, unit = _SHOWN_AS.get(name, (1.0, ""))
        values = [_shown(getattr(column, name), factor) for column in columns]
        values[1:] = ["." if value == values[0] else value for value in values[1:]]
        lines.append(f"| `{name}` | {unit} | {' | '.join(values)} |")
    return "\n".join(lines)


def _shown(value: object, factor: float) -> str:
    if isinstance(value, tuple):
        return ", ".join(_shown(entry, factor) for entry in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{factor * value:.3g}" if isinstance(value, int | float) else str(value)


if __name__ == "__main__":
    print(preset_table())
