"""Write the transmission file of a hand whose figures have changed."""

from __future__ import annotations

import datetime
import json
import math
from pathlib import Path
from typing import Any

from .._files import write_whole
from ..exceptions import DescriptionError
from ..typing import Array
from ._toml import read_toml
from .hand import HandDescription
from .mjcf_hand import read_mjcf

_ENDING = ".transmission.toml"


def write_transmission(hand: HandDescription, path: str | Path) -> Path:
    """Write springs, rest angles, friction, moment arms, offsets, stiffness and play of ``hand`` to ``path``.

    Everything else (ranges, couplings, pads, sensors, notes) is that of ``hand.transmission_path``; comments
    are lost. The URDF is copied next to it if there is none, so that ``load_hand`` reads the hand back; an
    MJCF is not, since it may be of several files.

    Args:
        hand: its description.
        path: ends in ".transmission.toml".

    Raises:
        DescriptionError: another ending, or the file that the hand was read from is gone.
        OutputError: the folder cannot be written to.
    """
    path = Path(path)
    if not path.name.endswith(_ENDING):
        raise DescriptionError(path, f"the name must end in '{_ENDING}'")
    if hand.transmission_path.is_file() or hand.urdf_path.suffix == ".urdf":
        data = read_toml(hand.transmission_path, "transmission file")
    else:
        data = read_mjcf(hand.urdf_path).tables
    for j, name in enumerate(hand.joint_names):
        data["joints"][name] = {
            "spring": float(hand.spring_stiffness[j]),
            "rest": float(hand.spring_rest[j]),
            "friction": float(hand.joint_friction[j]),
        }
    rows = zip(hand.actuators, data["actuators"], hand.actuation_jacobian, hand.lengths.typical, strict=True)
    for actuator, table, arms, typical in rows:
        _write_arms(hand, table, arms * actuator.unit, typical)
        for key in ("stiffness", "offset", "offset_deg", "backlash", "backlash_deg"):
            table.pop(key, None)
        if math.isfinite(actuator.stiffness):
            table["stiffness"] = float(actuator.stiffness) / actuator.unit**2
        for key in ("offset", "backlash"):
            if getattr(actuator, key):
                table[key] = float(getattr(actuator, key)) * actuator.unit
    write_whole(path, document(data))
    urdf = path.with_name(path.name.removesuffix(_ENDING) + ".urdf")
    if not urdf.exists() and hand.urdf_path.suffix == ".urdf":
        write_whole(urdf, hand.urdf_path.read_bytes())
    return path


def _write_arms(hand: HandDescription, table: dict[str, Any], arms: Array, typical: Array) -> None:
    """Constant arms as they are now, functions and tendons by the factors of their typical ones."""
    if "mjcf_tendons" in table:
        factor = float(arms @ typical) / float(typical @ typical)
        table["mjcf_tendons"] = {name: factor * weight for name, weight in table["mjcf_tendons"].items()}
        return
    written: dict[str, Any] = {}
    for name, arm, was in zip(hand.joint_names, arms.tolist(), typical.tolist(), strict=True):
        value = table["moment_arms"].get(name, 0.0)
        if isinstance(value, list):
            value = [coefficient * arm / was for coefficient in value]
        elif isinstance(value, dict):
            value = value | {"arm": [one * arm / was for one in value["arm"]]}
        elif arm != 0:
            value = arm
        else:
            continue
        written[name] = value
    table["moment_arms"] = written


def document(data: dict[str, Any]) -> str:
    """Tables of a transmission file as TOML."""
    lines: list[str] = []
    for name, value in data.items():
        for table in value if isinstance(value, list) else [value]:
            lines += ["", f"[[{name}]]" if isinstance(value, list) else f"[{name}]"]
            lines += [f"{toml_key(key)} = {_value(entry)}" for key, entry in table.items()]
    return "\n".join(lines[1:]) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml_key(key)} = {_value(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    # numbers, booleans and strings are written alike in JSON and in TOML
    return json.dumps(value, ensure_ascii=False)


def toml_key(key: str) -> str:
    """A key as it is written in TOML."""
    return key if key.replace("_", "").replace("-", "").isalnum() and key.isascii() else json.dumps(key)
