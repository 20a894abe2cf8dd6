"""A pinch that was planned in an earlier test is not planned again: that is half of what a grasp costs.

A plan follows from its problem and its request alone. Tests of the planner call it themselves, and those
that compare a run with its repetition ask for ``planned_anew``.
"""

from __future__ import annotations

import copy
import pickle
import sys
from typing import Any

remembers = True
_planned: dict[bytes, Any] = {}


def install() -> None:
    """Remember what simulated hands plan, if a test that was collected has them."""
    hand = sys.modules.get("torch_ekm.simulation.simulated_hand")
    if hand is None:
        return
    from torch_ekm.simulation.grasp_planning import pinch

    def plan_pinch(problem: Any, request: Any) -> Any:
        if not remembers:
            return pinch.plan_pinch(problem, request)
        parts = {name: part for name, part in vars(problem).items() if name != "kinematics"}
        key = pickle.dumps((parts, request, pinch._GUESSES))
        if key not in _planned:
            _planned[key] = pinch.plan_pinch(problem, request)  # what cannot be planned is told anew
        return copy.deepcopy(_planned[key])

    hand.plan_pinch = plan_pinch
