"""What a control board of YARP answers on its rpc port."""

from __future__ import annotations

import re
from typing import Any


def answer(text: str, motors: Any, first: int = 0, modes: dict[int, str] | None = None) -> str:
    """``[get] [encs]``, ``[get] [dons]``, ``[get] [icmd] [cmds]``, ``[set] [icmd] [cmod] axis mode``,
    ``[set] [pos] axis degrees``; any other command is taken.

    Args:
        text: the command.
        motors: :class:`~motors.Motors` or the like, in degrees.
        first: axis of the first motor; those before it stand at 0.
        modes: of the axes; one that is not in ``[pos]`` takes no position. None: all are.
    """
    axes = first + len(motors.goal)
    if text == "[get] [icmd] [cmds]":
        said = " ".join("[pos]" if modes is None else modes.get(k, "[idle]") for k in range(axes))
        return f"[is] [cmds] ({said}) 1.5 [ok]"
    changed = re.fullmatch(r"\[set\] \[icmd\] \[cmod\] (\d+) (\S+)", text)
    if changed is not None and modes is not None:
        if modes.get(int(changed[1])) == "[hwf]":  # a fault is first cleared by [fidl]
            return "[fail]"
        modes[int(changed[1])] = changed[2]
    if text == "[get] [encs]":
        encoders = " ".join([*(["0.0"] * first), *(repr(x) for x in motors.now())])
        return f"[is] encs ({encoders}) 1.5 [ok]"
    if text == "[get] [dons]":
        goal = motors.goal
        return f"[is] dons ({' '.join([str(int(not motors.moving))] * (first + len(goal)))}) 1.5 [ok]"
    moved = re.fullmatch(r"\[set\] \[pos\] (\d+) (\S+)", text)
    if moved is not None:
        if modes is not None and modes.get(int(moved[1])) != "[pos]":
            return "[fail]"
        goal = list(motors.goal)
        goal[int(moved[1]) - first] = float(moved[2])
        if motors.together and int(moved[1]) < axes - 1:
            motors.goal = goal
        else:
            motors.send(goal)
    return "[ok]"
