"""Pinches that were planned before in this process: several controllers often try the same grasps."""

from __future__ import annotations

import copy
import hashlib
import pickle

from .pinch import PinchPlan, plan_pinch
from .pinch_problem import PinchProblem, PinchRequest

_MOST = 1000  # plans of some 10 kB
_plans: dict[bytes, PinchPlan] = {}


def remembered_pinch(problem: PinchProblem, request: PinchRequest) -> PinchPlan:
    """What :func:`plan_pinch` says, which follows from its arguments alone, and takes half of a grasp's time.

    Raises:
        EquilibriumError: as there; what cannot be planned is tried again.
    """
    parts = {name: part for name, part in vars(problem).items() if name != "kinematics"}  # of the hand
    key = hashlib.sha256(pickle.dumps((parts, request))).digest()
    if key not in _plans:
        plan = plan_pinch(problem, request)
        if len(_plans) >= _MOST:
            _plans.pop(next(iter(_plans)))
        _plans[key] = plan
    return copy.deepcopy(_plans[key])
