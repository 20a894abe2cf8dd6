"""The severities as a table: ``python -m torch_ekm.simulation.severity_table``."""

from __future__ import annotations

import dataclasses
import math

from .parameters import PlantParameters
from .presets import SEVERITIES

_DEG = math.pi / 180
_ANGLES = ("tendon_elongation", "actuator_bias", "actuator_error", "dead_zone", "threshold", "backlash")
_SHOWN_AS = {name: (1 / _DEG, "deg") for name in (*_ANGLES, "joint_noise", "rotation_noise")}
_SHOWN_AS |= {name: (1e3, "mm") for name in ("com_shift", "position_noise")}
_SHOWN_AS |= {name: (1.0, "N") for name in ("force_noise", "force_offset", "force_hysteresis", "force_range")}
_SHOWN_AS |= {"tendon_creep": (1 / _DEG, "deg/(N m s)"), "latency": (1.0, "s")}


def severity_table() -> str:
    """All figures of all severities as a Markdown table, with "." for what is as in "none"."""
    columns = [make() for make in SEVERITIES.values()]
    lines = [f"| parameter | unit | {' | '.join(SEVERITIES)} |", "|---" * (2 + len(SEVERITIES)) + "|"]
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
    print(severity_table())
