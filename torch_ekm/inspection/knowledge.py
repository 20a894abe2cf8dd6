"""The estimates of a closed loop of its hand, beside the description."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from ..control import HandKnowledge
from ..description import load_hand
from ..estimation.hand_figures import HandFigures
from ..estimation.knowledge import Part, previous
from ..exceptions import EKMError
from ..kinematics import ServoModel

NOT_IDENTIFIED = "not identified"
_DEG = math.pi / 180


class Estimated(NamedTuple):
    """One figure of a hand."""

    part: Part
    name: str
    """Of the actuator, the pad, or the figure."""
    figure: str
    """What it is, and its unit."""
    value: float
    std: float | None
    """Standard error of the value; None: it has none."""
    described: float | None
    """What holds where nothing is learned; None: nothing does."""
    note: str

    @property
    def deviates(self) -> bool:
        """By more than two standard errors from what is described, or something is to be said of it."""
        if self.described is None or self.std is None or self.note:
            return self.note != NOT_IDENTIFIED
        return abs(self.value - self.described) > 2 * self.std


def about(knowledge: HandKnowledge, file: Path, hand: str = "") -> dict[str, str | int]:
    """Since when it is known, and whether it is of the hand as that is described now.

    Args:
        file: it was loaded from.
        hand: its name; else the one that it was learned of.
    """
    named = hand or getattr(knowledge.figures, "hand", "")
    try:
        knowledge.check(load_hand(named).counted())
        against = f"that of '{named}'"
    except EKMError as error:
        against = str(error) if named else "the file names no hand: --hand"
    head: dict[str, str | int] = {"written": _date(file), "motions": int(knowledge.figures.count)}
    if previous(file).is_file():
        head["before it"] = f"{previous(file)}, {_date(previous(file))}"
    return {**head, "description": against}


def _date(file: Path) -> str:
    return datetime.fromtimestamp(file.stat().st_mtime).isoformat(" ", "minutes")


def estimates(knowledge: HandKnowledge) -> list[Estimated]:
    """All figures of a :class:`~torch_ekm.control.HandKnowledge`, part by part."""
    servo, forces, learned, error = knowledge.servo, knowledge.forces, knowledge.figures, knowledge.error
    found = []
    if isinstance(servo, ServoModel):
        learned_of = ("dead zone [deg]", servo.dead_zone), ("bias [deg]", servo.bias)
        for (figure, values), stds in zip(learned_of, servo.standard_errors, strict=True):
            found += [
                Estimated("servo", name, figure, value / _DEG, std / _DEG, 0.0, "stuck" * bool(stuck))
                for name, value, std, stuck in zip(
                    servo.names, values.tolist(), stds.tolist(), servo.stuck, strict=True
                )
            ]
    for i, (scale, std) in enumerate(zip(forces.scale.tolist(), forces.scale_std.tolist(), strict=True)):
        found.append(Estimated("forces", f"pad {i}", "of the model's answer", scale, std, 1.0, ""))
    if isinstance(learned, HandFigures):
        for one in learned.figures:
            unit, figure = (_DEG, "width [deg]") if one.is_width else (1.0, "of its description")
            note = "" if one.identified else NOT_IDENTIFIED
            figures = (one.factor / unit, one.std / unit, one.described / unit)
            found.append(Estimated("figures", one.name, figure, *figures, note))
    for name, share in (("along", error.along), ("across", error.across)):
        found.append(Estimated("error", name, "share of a motion", share, None, None, ""))
    return found
