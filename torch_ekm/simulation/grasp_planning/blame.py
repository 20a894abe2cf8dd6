"""What is to blame where no pinch is found: the geometry, or the torques at the joints."""

from __future__ import annotations

import numpy as np

from ...typing import Array
from ..mechanism.assembly import chain
from .graspable import half_extent
from .pinch_problem import PinchGeometry, PinchProblem

_INSIDE = 0.5e-3  # [m] of a link in the object
_APART = 0.2e-3  # [m] between pad and object
_OFF = 1e-3  # [N m], as the planner's tolerance
_BENT = 0.05  # [rad] of a joint from its rest, below which no spring helps


class BorneProblem(PinchProblem):
    """The pinch of a hand whose joints bear what they must: pads, links, object and limits are as they are.

    Args:
        problem: the pinch with springs, tendons and motors.
        share: of the torques that nothing bears, which are to vanish: 0, or little, so that the geometry is
            right and they are the least.
    """

    def __init__(self, problem: PinchProblem, share: float = 0.0) -> None:
        self.__dict__.update(vars(problem))
        self.share = share

    def _unheld(self, g: PinchGeometry) -> Array:
        return self.share * super()._unheld(g)

    def tension(self, g: PinchGeometry) -> Array:
        return np.ones((len(g.q), self.hand.n_a))

    def outside(self, g: PinchGeometry) -> Array:
        return np.zeros((len(g.q), 0))


def blame_geometry(problem: PinchProblem, g: PinchGeometry) -> str:
    """What is wrong with the best posture of a hand whose joints bear any load [mm]."""
    found = []
    if (inside := -float(g.clearance.min())) > _INSIDE:
        link = problem.obstacle_links[int(g.clearance[0].argmin())]
        found.append(f"link '{link}' would be {1e3 * inside:.0f} mm inside it")
    for pad, gap in zip(problem.pads, g.gap[0].tolist(), strict=True):
        if abs(gap) > _APART:
            where = "away from it" if gap > 0 else "inside it"
            found.append(f"pad '{pad.name}' would be {1e3 * abs(gap):.1f} mm {where}")
    length, fingers = 2 * half_extent(problem.obj, problem.axes[:, 0]), problem.pads[1:]
    if len(fingers) > 1 and length < 2 * max(pad.radius for pad in fingers):
        names = " and ".join(f"'{pad.name}'" for pad in fingers)
        found.append(f"it is too small: {1e3 * length:.0f} mm, for pads {names} side by side")
    return "geometry is to blame: " + ("; ".join(found) or "the pads do not face one another on it")


def blame_torque(problem: PinchProblem, g: PinchGeometry) -> str:
    """What is wrong with the best posture in which the pads touch the object as wanted."""
    reach, hand = "the fingertips reach it", problem.hand
    off = problem.off_balance(g)[0]
    joint = int(np.abs(off).argmax())
    if abs(off[joint]) > _OFF:
        asked, name = abs(float(g.torque[0, joint])), hand.joint_names[joint]
        finger = next((pad.name for pad in problem.pads if joint in chain(hand, pad.link)), "")
        return (
            f"{reach}; torque is to blame: joint '{name}' of finger '{finger}' is "
            f"{1e3 * abs(off[joint]):.1f} mN m out of balance, where the contact asks {1e3 * asked:.1f} mN m"
            + _would_need(problem, g, joint, float(off[joint]))
        )
    if pushed := problem.slack(g):
        return f"{reach}; torque is to blame: tendon {' and '.join(map(repr, pushed))} would be slack"
    places = zip(hand.actuators, problem.motors(g)[0].tolist(), problem.in_use.tolist(), strict=True)
    if beyond := " and ".join(
        f"'{one.name}' ({_motor_text(one.lower, one.unit)} to {_motor_text(one.upper, one.unit)}) "
        f"at {_motor_text(at, one.unit)}"
        for one, at, used in places
        if used and not one.lower <= at <= one.upper
    ):
        return f"{reach} in balance; its range is to blame: the best takes actuator {beyond}"
    return f"{reach}; torque is to blame: the joints are in balance only in bad postures"


def _would_need(problem: PinchProblem, g: PinchGeometry, joint: int, off: float) -> str:
    """The spring or the arm with which the joint is in balance as it stands; empty: none does it."""
    hand, found = problem.hand, []
    change = -off / problem.passive_share(joint)  # of the torque of this joint alone
    bent, spring = float(g.q[0, joint] - hand.spring_rest[joint]), float(hand.spring_stiffness[joint])
    if spring and abs(bent) > _BENT and (stiffer := spring + change / bent) > 0:
        found.append(f"a spring of {stiffer:.2g} N m/rad, not {spring:.2g}")
    arms, load = problem.transmission.arms(g.q).reshape(-1, hand.n_q), problem.joint_load(g)[0]
    pulling = np.flatnonzero(arms[:, joint])
    others = np.flatnonzero(arms[pulling[0]]) if len(pulling) == 1 else np.zeros(0, int)
    others = others[others != joint]
    if len(others):
        own = arms[pulling[0]]
        tension = float(own[others] @ load[others] / (own[others] @ own[others]))
        arm = load[joint] / tension if tension else 0.0
        if arm * own[joint] > 0:
            motor = hand.actuators[pulling[0]]
            way = "below" if abs(arm) < abs(own[joint]) else "above"
            arm, now = (abs(one) * motor.unit for one in (arm, own[joint]))
            found.append(f"an arm of '{motor.name}' {way} {arm:.2g}, not {now:.2g}")
    return f"; it would need {', or '.join(found)}" if found else ""


def _motor_text(at: float, unit: float) -> str:
    """In the owner's unit: [deg] of motors that count in rad."""
    return f"{np.degrees(at):.0f} deg" if unit == 1 else f"{at * unit:.3g}"
