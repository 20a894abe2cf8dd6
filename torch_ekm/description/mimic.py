"""``<mimic>`` of a URDF: joints that are tied to others, as the couplings of a transmission file say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..exceptions import DescriptionError
from ..typing import Array

_CLOSE = 1e-6  # of weights
_RESTS = 1e-3  # [rad]: an angle written with few digits


@dataclass(frozen=True)
class Mimic:
    """``q_joint = multiplier q_other + offset``, offset [rad]."""

    joint: str
    other: str
    multiplier: float
    offset: float

    def coupling(self) -> dict[str, float]:
        """Weights of the rigid coupling that says the same of increments."""
        return {self.joint: 1.0, self.other: -self.multiplier}


def read_mimics(path: Path, joints: Sequence[Any]) -> tuple[Mimic, ...]:
    """The ``<mimic>`` of all moving joints, of the ``yourdfpy.Joint`` of a file.

    Raises:
        DescriptionError: one names no other moving joint, or has the multiplier 0.
    """
    moving = [joint.name for joint in joints if joint.type != "fixed"]
    found = []
    for joint in joints:
        if joint.mimic is None:
            continue
        place, other = f"joint '{joint.name}': <mimic>", joint.mimic.joint
        if other not in moving or other == joint.name:
            valid = ", ".join(one for one in moving if one != joint.name)
            raise DescriptionError(path, f"{place} names '{other}', which must be one of {valid}")
        if joint.mimic.multiplier == 0:
            raise DescriptionError(path, f"{place}: 'multiplier' is 0; make it a fixed joint")
        found.append(Mimic(joint.name, other, joint.mimic.multiplier, joint.mimic.offset))
    return tuple(found)


def check_mimics(
    path: Path, urdf: Path, mimics: Sequence[Mimic], names: Sequence[str], C: Array, rest: Array
) -> None:
    """Each ``<mimic>`` must follow from the couplings ``C q = C q0``.

    Args:
        path, urdf: of the transmission file and of the URDF.
        C: ``(n_k, n_q)``.
        rest: q0, ``(n_q,)`` [rad].

    Raises:
        DescriptionError: a coupling is missing, or the rest angles contradict the offset.
    """
    for mimic in mimics:
        row = np.zeros(len(names))
        for name, weight in mimic.coupling().items():
            row[list(names).index(name)] = weight
        apart = row @ np.linalg.pinv(C) @ C - row if C.size else row
        if np.abs(apart).max() > _CLOSE * np.abs(row).max():
            weights = ", ".join(f"{name} = {weight:g}" for name, weight in mimic.coupling().items())
            problem = f"'{mimic.joint}' is a <mimic> of '{mimic.other}' in {urdf}: add [[couplings]] with"
            raise DescriptionError(path, f"{problem} joints = {{ {weights} }}")
        if abs(row @ rest - mimic.offset) > _RESTS:
            wanted = mimic.multiplier * rest[list(names).index(mimic.other)] + mimic.offset
            problem = f"[joints] {mimic.joint}: as a <mimic> of '{mimic.other}' in {urdf} it rests at"
            raise DescriptionError(path, f"{problem} {wanted:.6g} rad ({math.degrees(wanted):.6g} deg)")
