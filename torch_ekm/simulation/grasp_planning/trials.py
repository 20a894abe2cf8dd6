"""Which single change makes a pinch hold that the planner does not find, and how little of it does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...description import HandDescription, ObjectDescription
from ...typing import Array
from ..config import PlantConfig
from ..parameters import PlantParameters
from .pinch import pinch_problem, solve
from .pinch_problem import PinchRequest

_MOST = 1.6  # largest change: the log of a factor, [rad], or a share of a range
_HALVINGS = 4  # between no change and the largest


@dataclass(frozen=True)
class Case:
    """A hand, an object and a force."""

    hand: HandDescription
    obj: ObjectDescription
    request: PinchRequest


def smallest_changes(
    hand: HandDescription, obj: ObjectDescription, config: PlantConfig, parameters: PlantParameters
) -> list[str]:
    """Changes of force, width, springs, limits or ranges that make the pinch hold; none: no single one does.

    Of each kind the planner tries the largest, and halves it while it finds a pinch.

    Args:
        hand, obj, config, parameters: as of the plant that cannot hold it.
    """
    force = hand.pinch_force if config.pinch_force is None else config.pinch_force

    def pinch(case: Case, *guesses: Array) -> Array | None:
        problem = pinch_problem(case.hand, case.obj, config, parameters)
        found = solve(problem, case.request, guesses or None)
        return found.x if found.holds and found.across else None

    case = Case(hand, obj, PinchRequest(force))
    if pinch(case) is not None:
        return ["fingertips centred on the object (spread = 0), as it is otherwise"]
    told = []
    for changed, text in _changes(case):
        low, high = 0.0, _MOST
        if (x := pinch(changed(high))) is None:
            continue
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            found = pinch(changed(middle), x)
            low, high, x = (middle, high, x) if found is None else (low, middle, found)
        told.append(text(high))
    return told


def _changes(case: Case) -> Iterator[tuple[Callable[[float], Case], Callable[[float], str]]]:
    """The case with a change of some size, and the change in words."""
    hand, obj, request = case.hand, case.obj, case.request

    def narrower(u: float) -> Case:
        s = float(np.exp(-u))
        shapes = tuple(one.scaled(s) for one in obj.shapes)
        return replace(case, obj=replace(obj, shapes=shapes, grasp_width=s * obj.grasp_width))

    def gentler(u: float) -> Case:
        return replace(case, request=replace(request, force=request.force * float(np.exp(-u))))

    def stiffer(u: float) -> Case:
        return replace(case, hand=replace(hand, spring_stiffness=hand.spring_stiffness * np.exp(u)))

    def freer(u: float) -> Case:
        limits = {"joint_lower": hand.joint_lower - u, "joint_upper": hand.joint_upper + u}
        return replace(case, hand=replace(hand, **limits))

    def longer(u: float) -> Case:
        motors = []
        for one in hand.actuators:
            by = u * (one.upper - one.lower)
            motors.append(replace(one, lower=one.lower - by, upper=one.upper + by))
        return replace(case, hand=replace(hand, actuators=tuple(motors)))

    width = 1e3 * obj.grasp_width
    yield gentler, lambda u: f"a pinch_force of {request.force * np.exp(-u):.2g} N"
    yield narrower, lambda u: f"an object {width * np.exp(-u):.1f} mm wide, not {width:.1f}"
    yield stiffer, lambda u: f"springs {np.exp(u):.1f} times as stiff"
    yield freer, lambda u: f"limits of the joints {np.degrees(u):.0f} deg farther apart at either end"
    yield longer, lambda u: f"ranges of the actuators {100 * u:.0f} % longer at either end"
