"""Least squares from measured motions to the figures of a hand."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from ..._extras import require
from ...exceptions import GraspError, ParameterError
from ...typing import Array
from ..kinematic_model import KinematicModel
from .identifiability import unidentified
from .motions import Recording, rests
from .parameters import Unknowns
from .residuals import GROUPS, Evidence, Residuals
from .result import Calibration

_SMALLEST_NOISE = 1e-2  # of the standard deviations at the start: below, the model's own error is left
_ROUNDS = 3  # of estimating the noise


def calibrate(
    model: KinematicModel,
    recordings: Iterable[Recording],
    parameters: Iterable[str] = ("springs", "moment_arms", "stiffness"),
    *,
    priors: Mapping[str, float] | None = None,
    loss: str = "linear",
) -> Calibration:
    """``min_x |W r(x)|^2 + |x|^2``: figures of the hand from measured motions, and how sure they are.

    ``r``: motions against ``J_m``, joint torques that no force explains, fingertip forces
    (:class:`~torch_ekm.model.calibration.residuals.Evidence`). ``x``: distance of each parameter from its
    description, in units of its prior. ``W``: one standard deviation for each kind of residual, estimated
    from the residuals in turn with x. Bounds: five priors, and no negative play. The derivative is that of
    :meth:`KinematicModel.linearize`; solved by scipy's trust-region reflective least squares.

    The scale of all springs and stiffnesses together is told by fingertip forces alone (and a little by
    the object's weight): without them expect ratios.

    Args:
        model: of the hand as described and of the object that was moved.
        recordings: trajectories of it, say 30 motions of 1 to 3 deg in several grasps. The encoders' readings
            give the increments, so the faults of a position controller do no harm.
        parameters: kinds ("springs", "rest", "moment_arms", "stiffness", "backlash", "object_position",
            "object_rotation"), or one of a kind: "springs:thumb_2", "moment_arms:thumb_distal".
        priors: standard deviations in place of
            :data:`~torch_ekm.model.calibration.parameters.PRIORS`, by kind.
        loss: of scipy's ``least_squares``; "soft_l1" where some motions slipped.

    Raises:
        UnknownNameError: no such kind of parameter, joint or actuator.
        ParameterError: no motion can be used, or a prior is not positive.
    """
    unknowns = Unknowns(model.hand, parameters, priors)
    evidence = Evidence(model, rests(recordings), unknowns)
    start = np.maximum(np.zeros(len(unknowns)), unknowns.bounds[0])
    before = evidence(start)
    if not len(before.motion):
        reason = "with two states in a row at which the object is held and its forces are found"
        raise ParameterError("recordings", "no usable motion", reason)
    problem, x = _Problem(evidence, before), start
    for _ in range(_ROUNDS):
        at = require("scipy.optimize").least_squares(
            problem.residuals, x, problem.jacobian, unknowns.bounds, loss=loss, xtol=1e-6, ftol=1e-8
        )
        x = at.x
        problem.estimate_noise(x)
    after = problem.at(x)
    information = problem.information(x)
    covariance = np.linalg.inv(information + np.eye(len(x)))
    return Calibration(
        model=model,
        unknowns=unknowns,
        x=x,
        covariance=covariance,
        errors_before=before.motion,
        errors_after=after.motion,
        noise={name: float(s * problem.noise[k]) for k, (name, s) in enumerate(GROUPS.items())},
        unidentified=unidentified(unknowns.parameters, information),
    )


class _Problem:
    """The residuals as scipy wants them, each point computed once, the priors as last rows."""

    def __init__(self, evidence: Evidence, start: Residuals) -> None:
        self.evidence, self.noise = evidence, np.ones(len(GROUPS))
        self.size, self._key, self._last = len(start.value), None, start

    def at(self, x: Array) -> Residuals:
        if self._key is None or not np.array_equal(self._key, x):
            self._last, self._key = self.evidence(x), x.copy()
        return self._last

    def residuals(self, x: Array) -> Array:
        try:
            at = self.at(x)
        except GraspError:  # the search then takes a smaller step
            return np.full(self.size + len(x), np.inf)
        return np.concatenate([at.value / self.noise[at.group], x])

    def jacobian(self, x: Array) -> Array:
        at = self.at(x)
        return np.concatenate([at.jacobian / self.noise[at.group, None], np.eye(len(x))])

    def information(self, x: Array) -> Array:
        """Fisher information of the data alone, ``J^T W^2 J``."""
        at = self.at(x)
        scaled = at.jacobian / self.noise[at.group, None]
        return scaled.T @ scaled

    def estimate_noise(self, x: Array) -> None:
        """Standard deviation of each kind of residual, each bearing its share of the parameters."""
        at = self.at(x)
        share = max(0.1, 1 - len(x) / len(at.value))
        for k in range(len(GROUPS)):
            own = at.value[at.group == k]
            if own.size:
                self.noise[k] = max(_SMALLEST_NOISE, float(np.sqrt(np.mean(own**2) / share)))
