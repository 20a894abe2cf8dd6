"""Which single change makes a pinch hold that the planner does not find, and how little of it does."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...description import HandDescription, ObjectDescription
from ...typing import Array
from ..config import PlantConfig
from ..parameters import PlantParameters
from .pinch import pinch_problem, solve
from .pinch_problem import PinchRequest

_MOST = 1.6  # largest change: the log of a factor, [rad], or a share of a range
_HALVINGS = 4  # between no change and the largest


def smallest_changes(
    hand: HandDescription, obj: ObjectDescription, config: PlantConfig, parameters: PlantParameters
) -> list[str]:
    """Changes of force, width, springs, limits or ranges that make the pinch hold; none: no single one does.

    Of each kind the planner tries the largest, and halves it while it finds a pinch.

    Args:
        hand, obj, config, parameters: as of the plant that cannot hold it.
    """
    force = hand.pinch_force if config.pinch_force is None else config.pinch_force

    def pinch(guess: Array | None = None, **changed: Any) -> Array | None:
        case = {"hand": hand, "obj": obj, "force": force} | changed
        problem = pinch_problem(case["hand"], case["obj"], config, parameters)
        found = solve(problem, PinchRequest(case["force"]), None if guess is None else [guess])
        return found.x if found.holds and found.across else None

    if pinch() is not None:
        return ["fingertips centred on the object (spread = 0), as it is otherwise"]
    told = []
    for changed, text in _changes(hand, obj, force, pinch_problem(hand, obj, config, parameters).moving):
        low, high = 0.0, _MOST
        if (x := pinch(**changed(high))) is None:
            continue
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            found = pinch(x, **changed(middle))
            low, high, x = (middle, high, x) if found is None else (low, middle, found)
        told.append(text(high, x))
    return told


def _changes(
    hand: HandDescription, obj: ObjectDescription, force: float, moving: NDArray[np.intp]
) -> Iterator[tuple[Callable[[float], dict[str, Any]], Callable[[float, Array], str]]]:
    """Another hand, object or force, by a change of some size; and in words the one that gave a pinch."""

    def narrower(u: float) -> dict[str, Any]:
        s = float(np.exp(-u))
        shapes = tuple(one.scaled(s) for one in obj.shapes)
        return {"obj": replace(obj, shapes=shapes, grasp_width=s * obj.grasp_width)}

    def longer(u: float) -> dict[str, Any]:
        by = [(one, u * (one.upper - one.lower)) for one in hand.actuators]
        motors = tuple(replace(one, lower=one.lower - more, upper=one.upper + more) for one, more in by)
        return {"hand": replace(hand, actuators=motors)}

    def beyond(u: float, x: Array) -> str:
        """Limits that the pinch exceeds."""
        found = []
        for joint, at in zip(moving.tolist(), x[: len(moving)].tolist(), strict=True):
            edge = float(np.clip(at, hand.joint_lower[joint], hand.joint_upper[joint]))
            if edge != at:
                new, old = np.degrees([at, edge])
                found.append(f"'{hand.joint_names[joint]}' at {new:.0f} deg, not {old:.0f}")
        return f"limits of {' and '.join(found) or f'all joints {np.degrees(u):.0f} deg farther apart'}"

    width, low, up, springs = 1e3 * obj.grasp_width, hand.joint_lower, hand.joint_upper, hand.spring_stiffness
    yield (
        lambda u: {"force": force * float(np.exp(-u))},
        lambda u, _: f"a pinch_force of {force * np.exp(-u):.2g} N",
    )
    yield narrower, lambda u, _: f"an object {width * np.exp(-u):.1f} mm wide, not {width:.1f}"
    yield (
        lambda u: {"hand": replace(hand, spring_stiffness=springs * np.exp(u))},
        lambda u, _: f"springs {np.exp(u):.1f} times as stiff",
    )
    yield lambda u: {"hand": replace(hand, joint_lower=low - u, joint_upper=up + u)}, beyond
    yield longer, lambda u, _: f"ranges of the actuators {100 * u:.0f} % longer at either end"
