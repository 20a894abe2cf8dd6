"""What a control board of YARP answers on its rpc port."""

from __future__ import annotations

import re
from typing import Any


def answer(text: str, motors: Any, first: int = 0) -> str:
    """``[get] [encs]``, ``[get] [dons]``, ``[set] [pos] axis degrees``; any other command is taken.

    Args:
        text: the command.
        motors: :class:`~motors.Motors` or the like, in degrees.
        first: axis of the first motor; those before it stand at 0.
    """
    if text == "[get] [encs]":
        encoders = " ".join([*(["0.0"] * first), *(repr(x) for x in motors.now())])
        return f"[is] encs ({encoders}) 1.5 [ok]"
    if text == "[get] [dons]":
        goal = motors.goal
        return f"[is] dons ({' '.join([str(int(not motors.moving))] * (first + len(goal)))}) 1.5 [ok]"
    moved = re.fullmatch(r"\[set\] \[pos\] (\d+) (\S+)", text)
    if moved is not None:
        goal = list(motors.goal)
        goal[int(moved[1]) - first] = float(moved[2])
        motors.send(goal)
    return "[ok]"
