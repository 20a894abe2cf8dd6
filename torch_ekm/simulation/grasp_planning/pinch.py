"""Plan a pinch by least squares."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..._extras import require
from ...description import HandDescription, ObjectDescription
from ...exceptions import EquilibriumError, ParameterError
from ...kinematics import HandKinematics
from ...typing import Array
from ..config import PlantConfig
from ..mechanism.assembly import chain, make_transmission, true_object
from ..parameters import PlantParameters
from .graspable import half_extent
from .pinch_problem import PinchGeometry, PinchProblem, PinchRequest, opposition
from .requirements import require_two_pads_and_limits, unmet

_FACING = 0.7  # a pinch across the wished axis has 0.98 and more, one across another axis about 0
_POSTURES = 4096  # random ones, of which the best are first guesses
_GUESSES = 5  # first guesses that are tried before giving up
_STIFF_STEP = 0.002  # [s]; at 4 ms a hand with rigid actuators moves by 7 to 55 % another way
_UNDECIDED = 0.9  # of the largest eigenvalue: fingers on a circle bend about no common axis
_NEAR_AN_AXIS = np.cos(np.radians(15))  # the iCub's fingers bend about y to within 5 deg
_CLOSING_POSTURES = 9  # from open to closed, in which pads are asked which one opposes the others
_WIDER = np.pi / 4  # [rad] by which limits are moved to see which ones are in the way
_GOOD_COST = 20.0  # half a sum of squares; the wishes of a good pinch cost about 0.3
_INSIDE = 0.5e-3  # [m] of a link in the object
_BAD_COST = 100.0  # pads beside the object, or hand and object in one another


@dataclass(frozen=True)
class PinchPlan:
    """An equilibrium of hand and object, in the hand frame."""

    q: Array
    position: Array
    rotation: Array
    motor: Array
    """Motor positions that hold it ``(n_a,)`` [rad]."""
    forces: Array
    """Force of each finger on the object ``(n_pads, 3)`` [N]."""
    points: Array
    """Contact points ``(n_pads, 3)`` [m]."""
    normals: Array
    """Outward normals of the object there ``(n_pads, 3)``."""
    pads: tuple[str, ...]


class _Solution(NamedTuple):
    x: Array
    violation: float
    """Largest of gap / 0.1 mm, force / 10 mN, moment / 0.2 mN m, joint torque / 1 mN m."""
    outside: float
    """How far a motor is beyond its range [rad]; negative: inside."""
    cost: float

    def rank(self) -> tuple[bool, bool, float]:
        return self.violation > 1, self.outside > 0, self.cost

    @property
    def holds(self) -> bool:
        return self.violation <= 1 and self.outside <= 0 and self.cost <= _BAD_COST

    @property
    def good(self) -> bool:
        return self.violation < 0.2 and self.outside <= 0 and self.cost < _GOOD_COST


def plan_pinch(problem: PinchProblem, request: PinchRequest) -> PinchPlan:
    """``min_x |residuals(x)|^2`` within the joints' ranges, from seeded first guesses.

    Raises:
        EquilibriumError: no posture was found that holds the object as wanted, across its grasp axis.
    """
    found = _solve(problem, request)
    g = problem.geometry(found.x[None])
    motor = problem.motors(g)[0]
    if not found.holds:
        raise EquilibriumError(
            "pinch planner",
            f"no posture within the limits holds '{problem.obj.name}' with {request.force:g} N",
            pinch_hint(problem)
            or _limits_hint(problem, request)
            or _range_hint(problem, motor)
            or _size_hint(problem, g),
        )
    if np.abs(g.facing).min() < _FACING:
        raise EquilibriumError(
            "pinch planner",
            "the only pinch found holds the object across another axis than its 'grasp_axis'",
            pinch_hint(problem)
            or f"'{problem.obj.name}' may be too wide along {problem.obj.grasp_axis.round(3).tolist()} "
            "for this hand: name the axis along which it is thin",
        )
    return PinchPlan(
        q=g.q[0],
        position=g.position[0],
        rotation=g.rotation[0],
        motor=motor,
        forces=g.force[0],
        points=g.point[0],
        normals=g.normal[0],
        pads=tuple(pad.name for pad in problem.pads),
    )


def exists(problem: PinchProblem, request: PinchRequest) -> bool:
    """Whether some posture holds the object as wanted."""
    return _solve(problem, request).holds


def _solve(problem: PinchProblem, request: PinchRequest) -> _Solution:
    """The first good solution, or the best from all first guesses."""
    best = _Solution(np.zeros(0), np.inf, np.inf, np.inf)
    for guess in _guesses(problem, request):
        found = _descend(problem, request, guess, ranges=False)
        if found.violation <= 1 and found.outside > 0:
            found = _descend(problem, request, found.x, ranges=True)
        best = min(best, found, key=_Solution.rank)
        if best.good:
            break
    return best


def _descend(problem: PinchProblem, request: PinchRequest, guess: Array, ranges: bool) -> _Solution:
    low, high = problem.bounds()
    descend = partial(
        require("scipy.optimize").least_squares,
        lambda x: problem.residuals(x[None], request, ranges)[0],
        jac=lambda x: problem.jacobian(x, request, ranges),
        bounds=(low, high),
        x_scale="jac",
        max_nfev=150,
        ftol=1e-9,
        xtol=1e-9,
        gtol=1e-9,
    )
    start = np.clip(guess, low + 1e-9, high - 1e-9)
    try:
        found = descend(start)
    except np.linalg.LinAlgError:  # LAPACK's SVD does not converge on every processor: by another way
        found = descend(0.999 * start + 0.0005 * (low + high))
    g = problem.geometry(found.x[None])
    violation = float(np.abs(problem.equations(request, g)[0]).max())
    return _Solution(found.x, violation, float(problem.outside(g).max(initial=-np.inf)), found.cost)


def pinch_hint(problem: PinchProblem) -> str:
    """What the hand lacks for any pinch; empty if nothing is known."""
    return "; ".join(map(str, unmet(problem)))


def _limits_hint(problem: PinchProblem, request: PinchRequest) -> str:
    """Joints that a pinch would take beyond their limits; empty if wider limits give none either."""
    hand = problem.hand
    wider = replace(hand, joint_lower=hand.joint_lower - _WIDER, joint_upper=hand.joint_upper + _WIDER)
    thumb, *fingers = (pad.name for pad in problem.pads)
    freed = PinchProblem(wider, problem.obj, problem.transmission, thumb, tuple(fingers), problem.along)
    found = _solve(freed, request)
    at = found.x[: len(problem.moving)]
    low, high = (edge[: len(at)] for edge in problem.bounds())
    names = [hand.joint_names[joint] for joint in problem.moving]
    beyond = _places(names, at, *problem.joint_range, (at < low) | (at > high))
    if not (found.good and beyond):
        return ""
    return (
        f"it takes joint {beyond}: let the limits run some degrees beyond that; else less "
        "force, stiffer springs, another object"
    )


def _range_hint(problem: PinchProblem, motor: Array) -> str:
    """Actuators that the best posture takes out of their ranges; empty if there is none."""
    hand = problem.hand
    low, high = hand.actuator_lower, hand.actuator_upper
    out = problem.in_use & ((motor < low) | (motor > high))  # idle ones rest, give or take a rounding
    beyond = _places(hand.actuator_names, motor, low, high, out)
    remedy = "another range_deg, a smaller pinch_force, stiffer springs or another object"
    return f"the best takes actuator {beyond}: {remedy}" if beyond else ""


def _size_hint(problem: PinchProblem, g: PinchGeometry) -> str:
    """What is wrong with the object's size, by the best posture."""
    if (inside := -float(g.clearance.min())) > _INSIDE:
        return f"it is too wide: some link would be {1e3 * inside:.0f} mm inside it"
    length, pads = 2 * half_extent(problem.obj, problem.axes[:, 0]), problem.pads[1:]
    if len(pads) > 1 and length < 2 * max(pad.radius for pad in pads):
        names = " and ".join(f"'{pad.name}'" for pad in pads)
        return f"it is too small: {1e3 * length:.0f} mm, for pads {names} side by side"
    return "it may be too wide, or out of reach"


def _places(names: Sequence[str], at: Array, low: Array, high: Array, chosen: NDArray[np.bool_]) -> str:
    """``'left' (0 to 90 deg) at 97 deg and ...`` of those chosen; all angles [rad]."""
    at, low, high = np.degrees([at, low, high])
    return " and ".join(
        f"'{names[k]}' ({low[k]:.0f} to {high[k]:.0f} deg) at {round(at[k])} deg"
        for k in np.flatnonzero(chosen).tolist()
    )


def _guesses(problem: PinchProblem, request: PinchRequest) -> Iterator[Array]:
    """The object between the fingertips: in the preferred posture, then in those that suit it best."""
    for moving in itertools.chain([problem.preferred], _facing_postures(problem)):
        tips = problem.tips(moving)
        force = np.outer(np.ones(len(tips)), problem.towards) * request.force
        force[1:] *= -1.0 / max(1, len(tips) - 1)
        centre = (tips[0] + tips[1:].mean(axis=0)) / 2
        yield np.concatenate([moving, centre, np.zeros(3), force.ravel()])


def _facing_postures(problem: PinchProblem) -> Iterator[Array]:
    """Of random postures those with the pads face to face, a grasp width apart."""
    low, high = problem.joint_range
    moving = low + np.random.default_rng(0).uniform(size=(_POSTURES, len(low))) * (high - low)
    facing, opening = problem.opposition(moving)
    width = problem.obj.grasp_width
    misfit = np.maximum(0.0, 0.9 - facing).max(axis=1) + np.abs(opening - width) / width
    yield from moving[np.argsort(misfit)[: _GUESSES - 1]]


def pinch_problem(
    hand: HandDescription, obj: ObjectDescription, config: PlantConfig, parameters: PlantParameters
) -> PinchProblem:
    """The problem for the plant as it is: what closes the hand is not what is studied here.

    Raises:
        DescriptionError: fewer than two pads, or a joint that moves one has no limits.
        ParameterError: a time step that rigid actuators do not bear.
    """
    require_two_pads_and_limits(hand)
    thumb, fingers = opposing_pads(hand, config)
    transmission = make_transmission(hand, parameters)
    if transmission.stiff and config.time_step > _STIFF_STEP:
        valid = f"at most {_STIFF_STEP} s: '{hand.name}' has rigid or very stiff actuators"
        raise ParameterError("time_step", config.time_step, valid)
    along = turning_axis(hand, config)
    return PinchProblem(hand, true_object(obj, parameters), transmission, thumb, fingers, along)


def opposing_pads(hand: HandDescription, config: PlantConfig) -> tuple[str, tuple[str, ...]]:
    """Names of the pad that opposes the others, and of these."""
    names = [pad.name for pad in hand.pads]
    named = config.thumb or next((name for name in names if name.startswith("thumb")), None)
    thumb = named or names[_most_opposed(hand)]
    fingers = config.fingers
    if fingers is None:
        chosen = tuple(name for name in names if name.startswith(("index", "middle")))
        fingers = chosen or tuple(name for name in names if name != thumb)
    return thumb, fingers


def _most_opposed(hand: HandDescription) -> int:
    """The pad that faces the others best while the hand closes: ``max min_i`` of the pads' cosines."""
    if len(hand.pads) < 3:
        return 0
    kinematics, closing = HandKinematics(hand), np.linspace(0.0, 1.0, _CLOSING_POSTURES)[:, None]
    low, high = hand.joint_lower, hand.joint_upper
    ranged = np.isfinite(high - low)
    q = np.where(ranged, low, hand.spring_rest) + closing * np.where(ranged, high - low, 0.0)
    poses = kinematics(torch.from_numpy(q))
    T = np.stack([poses.of(pad.link).numpy() for pad in hand.pads], axis=1)
    tips = T[..., :3, :3] @ np.array([pad.end for pad in hand.pads])[..., None]
    tips = tips[..., 0] + T[..., :3, 3]
    directions = (T[..., :3, :3] @ np.array([pad.direction for pad in hand.pads])[..., None])[..., 0]
    pads = range(len(hand.pads))
    orders = ([one, *(pad for pad in pads if pad != one)] for one in pads)
    scores = [opposition(tips[:, at], directions[:, at])[0].min(axis=1).max() for at in orders]
    return int(np.argmax(scores))


def turning_axis(hand: HandDescription, config: PlantConfig) -> Array:
    """Unit vector along which the object's long axis is held, hand frame: see :class:`PlantConfig`.

    The first eigenvector of the sum of ``z z^T`` over the axes z of the pads' last joints.
    """
    given = config.along or hand.planar_normal
    if given is not None:
        return np.array(given) / np.linalg.norm(given)
    kinematics = HandKinematics(hand)
    axes = kinematics.joint_axes(kinematics(torch.from_numpy(hand.spring_rest)))[0].numpy()
    last = axes[[joints[0] for pad in hand.pads if (joints := chain(hand, pad.link))]]
    weights, vectors = np.linalg.eigh(last.T @ last)
    along, nearest = vectors[:, 2], np.eye(3)[np.abs(vectors[:, 2]).argmax()]
    if weights[1] > _UNDECIDED * weights[2]:
        return np.array([0.0, 1.0, 0.0])
    along = along * np.sign(along @ nearest)
    return nearest if along @ nearest > _NEAR_AN_AXIS else along
