"""Grasps that their own forces have made soft."""

from __future__ import annotations

import dataclasses

from .kinematic_model import KinematicModel
from .linearization import Linearization

_SOFTENS = 0.85  # of the stiffness without forces, below which a grasp is gripped no harder
_FORCES = "mu", "force", "normal", "spin_moment"


def softened(model: KinematicModel, lin: Linearization) -> bool:
    """Whether contact forces have taken so much of a grasp's stiffness that it is near buckling."""
    forces = dataclasses.replace(lin.forces, **{name: 0 * getattr(lin.forces, name) for name in _FORCES})
    free = model.linearize(lin.state, lin.contacts, forces=forces, on_unstable="flag")
    return float(lin.stability) < _SOFTENS * float(free.stability)
