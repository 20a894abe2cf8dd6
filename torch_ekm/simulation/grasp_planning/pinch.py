"""Plan a pinch by least squares."""

from __future__ import annotations

import copy
import hashlib
import itertools
import pickle
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch

from ..._arrays import null_space
from ..._extras import require
from ...description import HandDescription, ObjectDescription
from ...exceptions import EquilibriumError, ParameterError
from ...kinematics import HandKinematics
from ...typing import Array
from ..config import PlantConfig
from ..mechanism.assembly import chain, make_transmission, true_object
from ..parameters import PlantParameters
from .blame import BorneProblem, blame_geometry, blame_torque
from .graspable import opposition
from .pinch_problem import PinchProblem, PinchRequest
from .requirements import closes_pad, direction_unmet, require_two_pads_and_limits

_FACING = 0.7  # a pinch across the wished axis has 0.98 and more, one across another axis about 0
_POSTURES = 4096  # random ones, of which the best are first guesses
_GUESSES = 5  # first guesses that are tried before giving up
_STEPS = 150  # of a descent
_STIFF_STEP = 0.002  # [s]; at 4 ms a hand with rigid actuators moves by 7 to 55 % another way
_UNDECIDED = 0.9  # of the largest eigenvalue: fingers on a circle bend about no common axis
_NEAR_AN_AXIS = np.cos(np.radians(15))  # the iCub's fingers bend about y to within 5 deg
_CLOSING_POSTURES, _SPREADS = 9, 16  # from open to closed, and in each: which pad opposes the others
_FACES = 0.3  # cosine from which a pad opposes another
_GOOD_COST = 40.0  # half a sum of squares; 0.3 of a good pinch of 12 joints, 35 where servos turn 16 of them
_LITTLE = 0.1  # of the weight of torques: 1 mm of gap counts as 0.1 N m
_BAD_COST = 100.0  # pads beside the object, or hand and object in one another
_MOST_PLANS = 1000  # of some 10 kB
_plans: dict[bytes, PinchPlan] = {}


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


class Solution(NamedTuple):
    x: Array
    violation: float
    """Largest of gap / 0.1 mm, force / 10 mN, moment / 0.2 mN m, joint torque / 1 mN m."""
    outside: float
    """How far a motor is beyond its range [rad]; negative: inside."""
    cost: float
    facing: float
    """Least component of a normal along the object's grasp axis."""

    def rank(self) -> tuple[bool, bool, float]:
        return self.violation > 1, self.outside > 0, self.cost

    @property
    def holds(self) -> bool:
        return self.violation <= 1 and self.outside <= 0 and self.cost <= _BAD_COST

    @property
    def across(self) -> bool:
        """The object is held across its grasp axis."""
        return self.facing >= _FACING

    @property
    def good(self) -> bool:
        return self.violation < 0.2 and self.outside <= 0 and self.cost < _GOOD_COST


def plan_pinch(problem: PinchProblem, request: PinchRequest) -> PinchPlan:
    """``min_x |residuals(x)|^2`` within the joints' ranges, from seeded first guesses.

    Raises:
        EquilibriumError: no posture was found that holds the object as wanted, across its grasp axis.
    """
    found = solve(problem, request)
    g = problem.geometry(found.x[None])
    if not found.holds:
        what = f"no posture within the limits holds '{problem.obj.name}' with {request.force:g} N"
        raise EquilibriumError("pinch planner", what, pinch_hint(problem) or _blame(problem, request))
    if not found.across:
        what = "the only pinch found holds the object across another axis than its 'grasp_axis'"
        wide = f"'{problem.obj.name}' may be too wide along {problem.obj.grasp_axis.round(3).tolist()} "
        wide += "for this hand: name the axis along which it is thin"
        raise EquilibriumError("pinch planner", what, pinch_hint(problem) or wide)
    return PinchPlan(
        q=g.q[0],
        position=g.position[0],
        rotation=g.rotation[0],
        motor=problem.motors(g)[0],
        forces=g.force[0],
        points=g.point[0],
        normals=g.normal[0],
        pads=tuple(pad.name for pad in problem.pads),
    )


def remembered_pinch(problem: PinchProblem, request: PinchRequest) -> PinchPlan:
    """What :func:`plan_pinch` says, which follows from its arguments alone, and takes half of a grasp's time:
    several controllers of a process often try the same grasps.

    Raises:
        EquilibriumError: as there; what cannot be planned is tried again.
    """
    parts = {name: part for name, part in vars(problem).items() if name != "kinematics"}  # of the hand
    key = hashlib.sha256(pickle.dumps((parts, request))).digest()
    if key not in _plans:
        plan = plan_pinch(problem, request)
        if len(_plans) >= _MOST_PLANS:
            _plans.pop(next(iter(_plans)))
        _plans[key] = plan
    return copy.deepcopy(_plans[key])


def solve(problem: PinchProblem, request: PinchRequest, guesses: Iterable[Array] | None = None) -> Solution:
    """The first good solution, or the best from all first guesses."""
    best = Solution(np.zeros(0), np.inf, np.inf, np.inf, 0.0)
    for guess in _guesses(problem, request) if guesses is None else guesses:
        found = descend(problem, request, guess, ranges=False)
        if found.violation <= 1 and found.outside > 0:
            found = descend(problem, request, found.x, ranges=True)
        best = min(best, found, key=Solution.rank)
        if best.good:
            break
    return best


def descend(problem: PinchProblem, request: PinchRequest, guess: Array, ranges: bool) -> Solution:
    """The nearest minimum to a first guess."""
    low, high = problem.bounds()
    squares = partial(
        require("scipy.optimize").least_squares,
        lambda x: problem.residuals(x[None], request, ranges)[0],
        jac=lambda x: problem.jacobian(x, request, ranges),
        bounds=(low, high),
        x_scale="jac",
        max_nfev=_STEPS,
        ftol=1e-9,
        xtol=1e-9,
        gtol=1e-9,
    )
    start = np.clip(guess, low + 1e-9, high - 1e-9)
    with _threads().limit(limits=1):
        try:
            found = squares(start)
        except np.linalg.LinAlgError:  # LAPACK's SVD does not converge on every processor: by another way
            found = squares(0.999 * start + 0.0005 * (low + high))
    g = problem.geometry(found.x[None])
    violation, outside = np.abs(problem.equations(request, g)).max(), problem.outside(g).max(initial=-np.inf)
    facing = np.abs(g.facing).min()
    return Solution(found.x, float(violation), float(outside), float(found.cost), float(facing))


@cache
def _threads() -> Any:
    """Of the libraries of linear algebra, which are searched for once.

    Matrices are small: on a busy machine threads that wait for each other take up to a hundred times as long.
    """
    return require("threadpoolctl").ThreadpoolController()


def pinch_hint(problem: PinchProblem) -> str:
    """What the pads lack for any pinch; empty if nothing is known."""
    lacks = [(pad.name, direction_unmet(problem.hand, pad)) for pad in problem.pads]
    return "; ".join(f"pad '{name}': {'; '.join(lack)}" for name, lack in lacks if lack)


def _blame(problem: PinchProblem, request: PinchRequest) -> str:
    """Geometry or torque, with figures."""
    reach = solve(BorneProblem(problem), request)
    if not reach.holds:
        return blame_geometry(problem, problem.geometry(reach.x[None]))
    balanced = descend(problem, request, reach.x, ranges=False)
    if balanced.violation > 1:
        balanced = descend(BorneProblem(problem, _LITTLE), request, reach.x, ranges=False)
    return blame_torque(problem, problem.geometry(balanced.x[None]))


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
    moving = problem.coupled(moving)
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
    thumb = next((name for name in names if name.startswith("thumb")), None)
    both = tuple(name for name in names if name.startswith(("index", "middle")))
    fingers = config.fingers or (both if len(both) >= min(2, len(names) - 1) else ())
    if thumb is None or not fingers:
        thumb, others = _most_opposed(hand, names, thumb)
        fingers = tuple(name for name in fingers or others if name != thumb)
    return thumb, fingers


def _most_opposed(hand: HandDescription, names: list[str], thumb: str | None) -> tuple[str, tuple[str, ...]]:
    """The pad that faces the others best in some posture, and those that it faces there.

    ``max_q mean_i max(0, min(cos_i, cos_thumb))`` decides, cosines to the line between two pads, while the
    hand closes; joints that spread the fingers are anywhere.
    """
    kinematics, low, high = HandKinematics(hand), hand.joint_lower, hand.joint_upper
    ranged = np.isfinite(high - low)
    low, span = np.where(ranged, low, hand.spring_rest), np.where(ranged, high - low, 0.0)
    closing = np.repeat(np.linspace(0.0, 1.0, _CLOSING_POSTURES), _SPREADS)[:, None]
    closes = np.any([closes_pad(hand, pad) for pad in hand.pads], axis=0)
    spread = np.random.default_rng(0).uniform(size=(len(closing), hand.n_q))
    free = null_space(hand.coupling.reshape(-1, hand.n_q))
    q = low + np.where(closes, closing, spread) * span - hand.spring_rest
    poses = kinematics(torch.from_numpy(hand.spring_rest + q @ free @ free.T))
    T = np.stack([poses.of(pad.link).numpy() for pad in hand.pads], axis=1)
    tips = (T[..., :3, :3] @ np.array([pad.end for pad in hand.pads])[..., None])[..., 0] + T[..., :3, 3]
    directions = (T[..., :3, :3] @ np.array([pad.direction for pad in hand.pads])[..., None])[..., 0]
    found = []
    for one in range(len(names)) if thumb is None else [names.index(thumb)]:
        others = [pad for pad in range(len(names)) if pad != one]
        pairs = [opposition(tips[:, [one, pad]], directions[:, [one, pad]])[0].min(axis=1) for pad in others]
        faced = np.stack(pairs, axis=1)
        at = int(faced.clip(0.0).mean(axis=1).argmax())
        facing = tuple(names[pad] for pad, cos in zip(others, faced[at], strict=True) if cos > _FACES)
        found.append((float(faced[at].clip(0.0).mean()), names[one], facing))
    _, best, facing = max(found, key=lambda one: one[0])
    return best, facing or tuple(name for name in names if name != best)


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
