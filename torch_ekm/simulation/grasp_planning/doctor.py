"""The smallest change with which a pinch holds that the planner does not find."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ...description import HandDescription, ObjectDescription
from ...exceptions import EKMError
from ...typing import Array
from ..config import PlantConfig
from ..mechanism.assembly import chain, make_transmission, true_object
from ..parameters import PlantParameters
from .blame import BorneProblem, motor_text
from .pinch import across_axis, descend, minimise, pinch_problem, solve
from .pinch_problem import PinchGeometry, PinchProblem, PinchRequest

_MOST = 1.6  # largest change: the log of a factor, or [rad]
_WIDEST = 2.5  # [rad] by which a limit or a range is moved at first
_REFINING = 0.4  # of the time, for making changes smaller
_MUCH = 0.1  # a change that counts as much as a wish of the planner that is missed by its tolerance
_FINER = 4  # halvings between no change and the one that gives a pinch
_TRIED = 14  # changes that are tried: those that lower the planner's cost most
_SLOPE = 0.02  # change by which the cost's slope is taken
_AT_A_STOP = 1e-3  # [rad] from the end of the planner's range
_STEPS = 60  # of a descent
_FIRST = ("force", "width")  # their decrease is tried whatever the slope says
_LIKELY = ("range", "all springs")  # so is what lowers the cost of these
_CENTRED = "fingertips centred on the object (spread = 0), as it is otherwise"
_SHOWN = 3  # changes that are shown


@dataclass(frozen=True)
class Case:
    """A hand, an object and a force."""

    hand: HandDescription
    obj: ObjectDescription
    request: PinchRequest
    parameters: PlantParameters
    base: PinchProblem
    """As described."""

    @property
    def borne(self) -> bool:
        """The joints bear any load: geometry alone counts."""
        return isinstance(self.base, BorneProblem)

    def problem(self) -> PinchProblem:
        transmission = make_transmission(self.hand, self.parameters)
        return self.base.changed(self.hand, true_object(self.obj, self.parameters), transmission)


@dataclass(frozen=True)
class Change:
    """Of one figure, or of one figure in several fingers."""

    kind: str
    of: Callable[[float], Case]
    """The case, changed by that much: a logarithm of a factor, or an angle [rad]."""
    text: Callable[[float], str]
    joint: int = -1
    """Whose limit it is; -1: of none."""
    side: int = 0
    """Sign of the way in which it goes; 0: both are to be tried."""
    free: bool = True
    """The planner's cost depends on it smoothly."""


class Cure(NamedTuple):
    """What makes a pinch hold."""

    changes: list[str]
    """The smallest first; none: nothing was found in time."""
    failed: PinchGeometry
    """The one pinch that a hand has whose joints bear any load."""


def smallest_changes(
    hand: HandDescription,
    obj: ObjectDescription,
    config: PlantConfig,
    parameters: PlantParameters,
    seconds: float = 15.0,
) -> Cure:
    """Changes that make the pinch hold, the smallest of each of three kinds; a factor e counts as 1 rad.

    Of the changes that lower the planner's cost most steeply each is an unknown of the pinch that is wished
    to be small. Those that give a pinch are then made smaller as long as it holds.

    Args:
        hand, obj, config, parameters: as of the plant that cannot hold it.
        seconds: of processor time after which the search ends with what it has.
    """
    end = time.process_time() + seconds
    problem = pinch_problem(hand, obj, config, parameters)
    request = PinchRequest(hand.pinch_force if config.pinch_force is None else config.pinch_force)
    reach = solve(BorneProblem(problem), request)
    case = Case(hand, obj, request, parameters, problem if reach.holds else BorneProblem(problem))
    failed = problem.geometry(reach.x[None])
    starts = [reach.x]
    if not case.borne:
        best = solve(problem, request)
        if best.holds and across_axis(problem, best):
            return Cure([_CENTRED], failed)
        starts.append(best.x)
    held: list[tuple[float, int, Change, Array]] = []
    for n, change in enumerate(_steepest(case, starts)):
        if time.process_time() > end - _REFINING * seconds:
            break
        if (found := _with(case, change, starts)) is not None:
            held.append((abs(found[0]), n, change, found[1]))
    shown: dict[str, str] = {}
    least: list[tuple[float, str]] = []
    for size, _, change, x in sorted(held, key=lambda one: one[:2]):
        if change.kind in shown or len(shown) == _SHOWN:
            continue
        low, high = 0.0, size
        for _ in range(_FINER):
            middle = (low + high) / 2
            found = None if time.process_time() > end else _held(change.of(change.side * middle), x)
            low, high, x = (middle, high, x) if found is None else (low, middle, found)
        far = " (as far as geometry goes)" if case.borne else ""
        shown[change.kind] = change.text(change.side * high) + far
        least.append((high, shown[change.kind]))
    return Cure([text for _, text in sorted(least)], failed)


def _with(case: Case, change: Change, starts: list[Array]) -> tuple[float, Array] | None:
    """How much of a change gives a pinch, and the pinch."""
    for x in starts:
        size, near = _free(case, change, x) if change.free else (_WIDEST, x)
        if (found := _held(change.of(change.side * size), near)) is not None:
            return size, found
    return None


def _free(case: Case, change: Change, x: Array) -> tuple[float, Array]:
    """The compromise between a good pinch and a small change: how large it is, and the pinch."""
    problems: dict[float, PinchProblem] = {}

    def at(u: float) -> tuple[PinchProblem, PinchRequest]:
        changed = change.of(u)
        if u not in problems:
            problems[u] = changed.problem()
        return problems[u], changed.request

    def residuals(z: Array) -> Array:
        problem, request = at(float(z[-1]))
        return np.append(problem.residuals(z[None, :-1], request, True)[0], z[-1] / _MUCH)

    def jacobian(z: Array) -> Array:
        problem, request = at(float(z[-1]))
        own = np.vstack([problem.jacobian(z[:-1], request, True), np.zeros((1, len(z) - 1))])
        step = 1e-5 * np.eye(len(z))[-1]
        return np.column_stack([own, (residuals(z + step) - residuals(z - step)) / 2e-5])

    low, high = case.problem().bounds()
    ends = np.sort([0.0, change.side * _MOST])
    bounds = np.append(low, ends[0]), np.append(high, ends[1])
    z, _ = minimise(residuals, jacobian, bounds, np.append(x, change.side * _SLOPE), _STEPS)
    return abs(float(z[-1])), z[:-1]


def _held(case: Case, x: Array) -> Array | None:
    """The pinch that is found from a posture nearby."""
    try:
        problem = case.problem()
    except EKMError:
        return None  # no such hand
    found = descend(problem, case.request, x, ranges=False, most=_STEPS)
    if found.violation <= 1 and found.outside > 0:
        found = descend(problem, case.request, found.x, ranges=True, most=_STEPS)
    return found.x if found.holds and across_axis(problem, found) else None


def _steepest(case: Case, starts: list[Array]) -> list[Change]:
    """Force and width, and other changes in the direction that lowers the cost, the steepest first."""
    problem = case.problem()
    costs = [_cost(problem, case.request, x) for x in starts]
    scored: list[tuple[float, Change]] = []
    signs = ((change, sign) for change in _changes(case, problem) for sign in (-1, 1))
    for change in (replace(one, side=sign) for one, sign in signs if one.side in (0, sign)):
        try:
            changed = change.of(change.side * _SLOPE)
            new = changed.problem()
        except EKMError:
            continue
        for x, cost in zip(starts, costs, strict=True):
            moved = x.copy()
            if change.joint >= 0:
                moved[change.joint] += change.side * _SLOPE * _stopped(problem, x, change.joint, change.side)
            gain = (cost - _cost(new, changed.request, moved)) / max(cost, 1.0)
            first = gain > 0 if change.kind in _LIKELY else change.side < 0 and change.kind in _FIRST
            scored.append((np.inf if first else gain, change))
    best: dict[int, Change] = {}
    for gain, change in sorted(scored, key=lambda one: -one[0]):
        if gain > 0:
            best.setdefault(id(change), change)
    return list(best.values())[:_TRIED]


def _stopped(problem: PinchProblem, x: Array, joint: int, sign: int) -> bool:
    low, high = problem.bounds()
    return bool((high[joint] - x[joint] if sign > 0 else x[joint] - low[joint]) < _AT_A_STOP)


def _cost(problem: PinchProblem, request: PinchRequest, x: Array) -> float:
    return 0.5 * float(np.square(problem.residuals(x[None], request, True)).sum())


def _changes(case: Case, problem: PinchProblem) -> Iterator[Change]:
    obj, request = case.obj, case.request

    def weaker(u: float) -> Case:
        return replace(case, request=replace(request, force=request.force * np.exp(u)))

    def wider(u: float) -> Case:
        s = float(np.exp(u))
        shapes = tuple(one.scaled(s) for one in obj.shapes)
        return replace(case, obj=replace(obj, shapes=shapes, grasp_width=s * obj.grasp_width))

    width = 1e3 * obj.grasp_width
    yield Change("width", wider, lambda u: f"an object {width * np.exp(u):.1f} mm wide, not {width:.1f}")
    for place, joint in enumerate(problem.moving.tolist()):
        yield _limit(case, place, joint, -1)
        yield _limit(case, place, joint, 1)
    if case.borne:
        return
    yield Change("force", weaker, lambda u: f"a pinch_force of {request.force * np.exp(u):.2g} N", side=-1)
    groups = _groups(problem)
    for joints in groups:
        yield from _springs(case, joints)
        yield from _arms(case, joints)
    every = tuple(sorted({joint for joints in groups for joint in joints}))
    yield from (replace(one, kind=f"all {one.kind}s") for one in _springs(case, every))
    for k in np.flatnonzero(problem.in_use).tolist():
        yield _range(case, k, "lower", -1)
        yield _range(case, k, "upper", 1)


def _groups(problem: PinchProblem) -> list[tuple[int, ...]]:
    """Joints one by one, and those of one place in all fingers, and in all but the first."""
    chains = [chain(problem.hand, pad.link) for pad in problem.pads]
    groups: dict[tuple[int, ...], None] = {}
    for chosen in (*([one] for one in chains), chains, chains[1:]):
        for k in range(max(map(len, chosen), default=0)):
            groups[tuple(sorted({one[k] for one in chosen if k < len(one)}))] = None
    return list(groups)


def _springs(case: Case, joints: tuple[int, ...]) -> Iterator[Change]:
    hand, at = case.hand, list(joints)
    stiffness = hand.spring_stiffness[at]
    names = _names(hand, joints)
    if not stiffness.all():
        return  # a spring that is not there has no size to change

    def stiffer(u: float) -> Case:
        new = hand.spring_stiffness.copy()
        new[at] *= np.exp(u)
        return replace(case, hand=replace(hand, spring_stiffness=new))

    def bent(u: float) -> Case:
        new = hand.spring_rest.copy()
        new[at] += u
        return replace(case, hand=replace(hand, spring_rest=new))

    yield Change(
        "spring",
        stiffer,
        lambda u: f"a spring of {_list(stiffness * np.exp(u))} N m/rad at {names}, not {_list(stiffness)}",
    )
    rest = np.degrees(hand.spring_rest[at])
    yield Change(
        "rest",
        bent,
        lambda u: f"a spring's rest of {_list(rest + np.degrees(u))} deg at {names}, not {_list(rest)}",
    )


def _arms(case: Case, joints: tuple[int, ...]) -> Iterator[Change]:
    """Of all tendons at these joints, where one has an arm there."""
    hand = case.hand
    where = np.zeros_like(hand.actuation_jacobian, dtype=bool)
    where[:, list(joints)] = hand.actuation_jacobian[:, list(joints)] != 0
    alone = (hand.actuation_jacobian != 0).sum(axis=1) == 1  # of a joint's own motor: its gear
    where[alone] = False
    if not where.any():
        return

    def changed(u: float) -> Case:
        arms = hand.actuation_jacobian * np.exp(u * where)
        return replace(case, hand=replace(hand, actuation_jacobian=arms))

    units = np.array([one.unit for one in hand.actuators])
    arms = np.abs(hand.actuation_jacobian * units[:, None])[where]
    tendons = " and ".join(f"'{hand.actuator_names[k]}'" for k in np.flatnonzero(where.any(axis=1)))
    yield Change(
        "arm",
        changed,
        lambda u: (
            f"an arm of {_list(arms * np.exp(u))} of {tendons} at {_names(hand, joints)}, not {_list(arms)}"
        ),
    )


def _limit(case: Case, place: int, joint: int, side: int) -> Change:
    hand, edge = case.hand, "joint_lower" if side < 0 else "joint_upper"
    at = float(getattr(hand, edge)[joint])

    def beyond(u: float) -> Case:
        new = getattr(hand, edge).copy()
        new[joint] += u
        return replace(case, hand=replace(hand, **{edge: new}))

    def text(u: float) -> str:
        old, new = np.degrees([at, at + u])
        return f"a limit of '{hand.joint_names[joint]}' at {new:.0f} deg, not {old:.0f}"

    return Change("limit", beyond, text, place, side, free=False)


def _range(case: Case, k: int, edge: str, side: int) -> Change:
    hand, motor = case.hand, case.hand.actuators[k]
    at = getattr(motor, edge)

    def beyond(u: float) -> Case:
        actuators = list(hand.actuators)
        actuators[k] = replace(motor, **{edge: at + u})
        return replace(case, hand=replace(hand, actuators=tuple(actuators)))

    def text(u: float) -> str:
        old, new = (motor_text(one, motor.unit) for one in (at, at + u))
        return f"a range of '{motor.name}' with its {edge} end at {new}, not {old}"

    return Change("range", beyond, text, side=side, free=False)


def _names(hand: HandDescription, joints: tuple[int, ...]) -> str:
    return " and ".join(f"'{hand.joint_names[joint]}'" for joint in joints)


def _list(values: Array) -> str:
    texts = dict.fromkeys(f"{value:.3g}" for value in np.atleast_1d(values).tolist())
    return " and ".join(texts)
