"""Joints that are tied to others, by a URDF's ``<mimic>`` or by couplings, and joints that nothing holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..typing import Array
from ._reading import listed

_CLOSE = 1e-6  # of weights
_RESTS = 1e-3  # [rad]: an angle written with few digits
_LOOSE = 1e-9  # stiffness of a motion against the hand's stiffest, or 1 N m/rad
_PART = 1e-6  # of a joint in a motion


@dataclass(frozen=True)
class Mimic:
    """``q_joint = multiplier q_other + offset``, offset [rad]."""

    joint: str
    other: str
    multiplier: float
    offset: float

    def coupling(self) -> dict[str, float]:
        """Weights of the rigid coupling that says the same of increments; multiplier 0: a locked joint."""
        other = {self.other: -self.multiplier} if self.multiplier else {}
        return {self.joint: 1.0, **other}


def read_mimics(joints: Sequence[Any]) -> tuple[tuple[Mimic, ...], list[str]]:
    """The ``<mimic>`` of all moving joints, of the ``yourdfpy.Joint`` of a file, and notes.

    One that names a joint that does not move locks its joint (multiplier 0); one that names none, or closes a
    circle, is left out.
    """
    moving = [joint.name for joint in joints if joint.type != "fixed"]
    still = [joint.name for joint in joints if joint.type == "fixed"]
    found, odd, locked = [], [], []
    leads = {}  # to the last joint of each chain
    for joint in joints:
        if joint.mimic is None:
            continue
        other, multiplier = joint.mimic.joint, joint.mimic.multiplier
        end = other
        while end in leads:
            end = leads[end]
        if end == joint.name or other not in (*moving, *still):
            odd.append(f"{joint.name} (of {other})")
            continue
        if other in still:
            locked.append(f"{joint.name} (of {other})")
            multiplier = 0.0
        leads[joint.name] = other
        found.append(Mimic(joint.name, other, multiplier, joint.mimic.offset))
    notes = [listed("each <mimic> of no other joint, or in a circle, is left out", odd)] if odd else []
    notes += [listed("each <mimic> of a joint that does not move is locked", locked)] if locked else []
    return tuple(found), notes


def overruled(mimics: Sequence[Mimic], names: Sequence[str], C: Array, rest: Array) -> list[str]:
    """A note for each ``<mimic>`` that does not follow from the couplings ``C q = C q0``, which hold.

    Args:
        names: of the joints, ``n_q``.
        C: ``(n_k, n_q)``.
        rest: q0, ``(n_q,)`` [rad].
    """
    notes = []
    for mimic in mimics:
        row = np.zeros(len(names))
        for name, weight in mimic.coupling().items():
            row[list(names).index(name)] = weight
        apart = row @ np.linalg.pinv(C) @ C - row if C.size else row
        said = f"'{mimic.joint}' is a <mimic> of '{mimic.other}'"
        if np.abs(apart).max() > _CLOSE * np.abs(row).max():
            weights = ", ".join(f"{name} = {weight:g}" for name, weight in mimic.coupling().items())
            notes.append(f"{said}, and is not tied so: no [[couplings]] with joints = {{ {weights} }}")
        elif abs(row @ rest - mimic.offset) > _RESTS:
            offset = f"an offset of {math.degrees(mimic.offset):.6g} deg"
            notes.append(f"{said} with {offset}; the 'rest' of [joints] says another, which holds")
    return notes


def unheld_joints(names: Sequence[str], rows: Array, stiffness: Array) -> list[str]:
    """The joints that have a part in a motion v which no spring, actuator or coupling holds.

    ``B v = 0``, ``v^T K v = 0``.

    Args:
        names: of the joints, ``n_q``.
        rows: B, moment arms and couplings, ``(n, n_q)``.
        stiffness: K, of the springs, ``(n_q, n_q)`` [N m/rad].
    """
    _, singular, V = np.linalg.svd(rows)
    N = V[int((singular > 1e-9 * singular.max(initial=0.0)).sum()) :].T
    stiff, modes = np.linalg.eigh(N.T @ stiffness @ N)
    free = N @ modes[:, stiff <= _LOOSE * stiff.max(initial=1.0)]
    part = np.linalg.norm(free, axis=1)
    return [name for name, one in zip(names, part, strict=True) if one > _PART]
