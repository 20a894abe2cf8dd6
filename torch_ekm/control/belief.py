"""Where the object is, by what was seen and by what its motors did."""

from __future__ import annotations

from ..kinematics.se3 import exp
from ..plant import Observation
from .decision import Expectation
from .focus import FocusedPose, PoseTarget
from .pace import RELATIVE, ROTATION_NOISE, TRANSLATION_NOISE

_DRIVES = 0.04  # error of a motion that hardly turns the object, as a variance in that of two readings
_GATE = 9.0  # squared standard deviations, beyond which a reading is believed alone: the object slid


class Belief:
    """Kalman filter of the focused error e, each direction alone: a controller that meets its steps would
    else turn the object by most of a reading's noise::

        e- = e - M_c ds,  P- = P + Var[g] + (0.12 M_c ds)^2 + ...,  e = e- + P- / (P- + R) (M_c error - e-)

    ds is what f + g predict of what the encoders did; R the variance of a pose, as the plant states it.
    """

    def __init__(self, focus: FocusedPose, target: PoseTarget, seen: Observation) -> None:
        self._focus, self._target = focus, target
        unit = focus.matrix.new_tensor([TRANSLATION_NOISE] * 3 + [ROTATION_NOISE] * 3)
        self._usual = focus.matrix.square() @ unit.square()  # variance of a motion as measured
        self._error, self._variance = focus.matrix @ target.error(seen.state), self._usual / 2

    def see(self, seen: Observation, expected: Expectation | None) -> None:
        """A reading, and what was expected of the motion before it; None: nothing."""
        M, R = self._focus.matrix, self._usual / 2
        stated = seen.info.get("estimate", {}).get("pose_covariance")
        if stated is not None:
            R = (M @ stated @ M.mT).diagonal().nan_to_num().where(stated.isfinite().all(), R)
        measured = M @ self._target.error(seen.state)
        prior, share = measured, R.new_ones(R.shape)
        if expected is not None:
            ds, std = M @ expected.increment[-6:], expected.deviation[-6:]
            P = self._variance + M.square() @ std.square() + (RELATIVE * ds).square() + _DRIVES * self._usual
            prior = self._error - ds
            share = (P / (P + R)).where((measured - prior).square() <= _GATE * (P + R), 1.0)
        self._error, self._variance = prior + share * (measured - prior), share * R

    def target(self, seen: Observation) -> PoseTarget:
        """The target, moved by as much as the object is thought to be elsewhere than it was seen."""
        M, target = self._focus.matrix, self._target
        shift = M.mT @ (self._error - M @ target.error(seen.state))
        return PoseTarget(target.position + shift[:3], exp(shift[3:]) @ target.rotation)
