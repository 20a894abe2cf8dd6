"""Which joints of a hand move by themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..typing import Array

_LOOSE = 1e-9  # stiffness of a motion against the hand's stiffest, or 1 N m/rad
_PART = 1e-6  # of a joint in a motion


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
