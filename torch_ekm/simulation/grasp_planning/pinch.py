"""Plan a pinch by least squares."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..._extras import require
from ...description import HandDescription, ObjectDescription
from ...exceptions import EquilibriumError, ParameterError
from ...typing import Array
from ..config import PlantConfig
from ..mechanism.assembly import make_transmission, true_object
from ..parameters import PlantParameters
from .pinch_problem import PinchProblem, PinchRequest
from .requirements import require_two_pads_and_limits, unmet

_FACING = 0.7  # a pinch across the wished axis has 0.98 and more, one across another axis about 0
_GUESSES = 4  # first guesses that are tried before giving up
_STIFF_STEP = 0.002  # [s]; at 4 ms a hand with rigid actuators moves by 7 to 55 % another way
_GOOD_COST = 20.0  # half a sum of squares; the wishes of a good pinch cost about 0.3


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
    residual: float
    """Largest violation: gap / 0.1 mm, force / 10 mN, moment / 0.2 mN m, joint torque / 1 mN m."""


def plan_pinch(problem: PinchProblem, request: PinchRequest) -> PinchPlan:
    """``min_x |residuals(x)|^2`` within the joints' ranges, from seeded first guesses.

    Raises:
        EquilibriumError: no posture was found that holds the object as wanted, across its grasp axis.
    """
    least_squares = require("scipy.optimize").least_squares
    low, high = problem.bounds()
    best, violation, cost = np.zeros_like(low), np.inf, np.inf
    for guess in _guesses(problem, request):
        found = least_squares(
            lambda x: problem.residuals(x[None], request)[0],
            np.clip(guess, low + 1e-9, high - 1e-9),
            jac=lambda x: problem.jacobian(x, request),
            bounds=(low, high),
            x_scale="jac",
            max_nfev=150,
            ftol=1e-9,
            xtol=1e-9,
            gtol=1e-9,
        )
        worst = float(np.abs(problem.equations(found.x[None], request)[0]).max())
        if (worst > 1, found.cost) < (violation > 1, cost):
            best, violation, cost = found.x, worst, found.cost
        if violation < 0.2 and cost < _GOOD_COST:
            break
    if violation > 1.0:
        raise EquilibriumError(
            "pinch planner",
            f"the best posture violates equilibrium by {violation:.2g} times its tolerance",
            pinch_hint(problem)
            or f"the object '{problem.obj.name}' may be too wide, or out of reach, for a force of "
            f"{request.force} N at along = {request.along} m",
        )
    g = problem.geometry(best[None])
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
        motor=problem.motors(g),
        forces=g.force[0],
        points=g.point[0],
        normals=g.normal[0],
        pads=tuple(pad.name for pad in problem.pads),
        residual=violation,
    )


def pinch_hint(problem: PinchProblem) -> str:
    """What the hand lacks for any pinch; empty if nothing is known."""
    return "; ".join(map(str, unmet(problem)))


def _guesses(problem: PinchProblem, request: PinchRequest) -> Iterator[Array]:
    """The preferred posture, then seeded variations of it; the object between the fingertips."""
    generator = np.random.default_rng(0)
    low, high = problem.joint_range
    for trial in range(_GUESSES):
        moving = problem.preferred()
        if trial:
            moving = moving + generator.uniform(-0.3, 0.3, size=moving.shape) * (high - low)
        tips = problem.tips(moving)
        force = np.outer(np.ones(len(tips)), problem.towards) * request.force
        force[1:] *= -1.0 / max(1, len(tips) - 1)
        centre = (tips[0] + tips[1:].mean(axis=0)) / 2
        yield np.concatenate([moving, centre, np.zeros(3), force.ravel()])


def pinch_problem(
    hand: HandDescription, obj: ObjectDescription, config: PlantConfig, parameters: PlantParameters
) -> PinchProblem:
    """The problem for the plant as it is: what closes the hand is not what is studied here.

    Raises:
        DescriptionError: fewer than two pads, or a joint that moves one has no limits.
        ParameterError: a time step that rigid actuators do not bear.
    """
    require_two_pads_and_limits(hand)
    names = [pad.name for pad in hand.pads]
    thumb = config.thumb or next((name for name in names if name.startswith("thumb")), names[0])
    fingers = config.fingers
    if fingers is None:
        chosen = tuple(name for name in names if name.startswith(("index", "middle")))
        fingers = chosen or tuple(name for name in names if name != thumb)[:1]
    transmission = make_transmission(hand, parameters)
    if transmission.stiff and config.time_step > _STIFF_STEP:
        valid = f"at most {_STIFF_STEP} s: '{hand.name}' has rigid or very stiff actuators"
        raise ParameterError("time_step", config.time_step, valid)
    along = turning_axis(hand, config)
    return PinchProblem(hand, true_object(obj, parameters), transmission, thumb, fingers, along)


def turning_axis(hand: HandDescription, config: PlantConfig) -> Array:
    """Unit vector along which the object's long axis is held, hand frame."""
    along = np.array(config.along or hand.planar_normal or (0.0, 1.0, 0.0))
    return along / np.linalg.norm(along)
