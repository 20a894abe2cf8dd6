"""Least squares from measured motions to the figures of a hand."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from ..._extras import require
from ...exceptions import GraspError, StateError
from ...typing import Array
from ..kinematic_model import KinematicModel
from .parameters import Calibration, Unknowns
from .residuals import GROUPS, Evidence, Recording, Residuals, rests

_SMALLEST_NOISE = 1e-3  # of the standard deviations at the start: below, the model's own error is left
_UNSENSED = 0.5  # of the force problem's standard deviations, where no sensor measures their scale
_INSIDE = 0.1  # [priors] of its bound a search begins
_ROUNDS, _SETTLED = 8, 0.2  # of estimating the noise, at most; relative change at which it is known


def calibrate(
    model: KinematicModel,
    recordings: Iterable[Recording],
    parameters: Iterable[str] = ("springs", "moment_arms", "stiffness", "offset"),
) -> Calibration:
    """``min_x sum_k rho((W r)_k^2) + sum_j rho(x_j^2)``, ``rho(z) = 2 (sqrt(1 + z) - 1)``.

    The figures of the hand from measured motions, and how sure they are.

    ``r``: motions against ``J_m``, joint torques that no force explains, fingertip forces. ``x``: distance of
    each parameter from its description, in units of its prior. ``W``: the inverse of one standard deviation
    for each kind of residual, estimated from the residuals in turn with x. Bounds: five priors, and no
    negative play. The derivative is that of :meth:`KinematicModel.linearize`; solved by scipy's trust-region
    reflective least squares.

    The scale of all springs and stiffnesses together is determined by fingertip forces alone (and a little by
    the object's weight): without them expect ratios.

    Args:
        model: of the hand as described and of the object that was moved.
        recordings: trajectories of it, say 30 motions of 1 to 3 deg in several grasps. The encoders' readings
            give the increments, so the faults of a position controller do no harm.
        parameters: kinds ("springs", "rest", "moment_arms", "stiffness", "offset", "backlash"), or one
            of a kind: "springs:thumb_2", "moment_arms:thumb_distal".
            Priors are standard deviations of 0.5 (springs), 0.3 (moment arms), 0.7 (stiffness), these of the
            logarithm, 10 deg (rest), 5 deg (offset), 1 deg (backlash).

    Raises:
        UnknownNameError: no such kind of parameter, joint or actuator.
        StateError: no motion can be used.
    """
    unknowns = Unknowns(model.hand, parameters)
    evidence = Evidence(model, rests(recordings), unknowns)
    nominal = np.zeros(len(unknowns))
    start = np.maximum(nominal, unknowns.bounds[0] + _INSIDE)  # no derivative leads off a bound
    if not any(one and other for usable in evidence.usable for one, other in pairwise(usable)):
        needed = "motions between two successive states in which the object is held and its forces are found"
        raise StateError(f"no motion of the recordings can be used; needed are {needed}")
    before = evidence(nominal, jacobian=False)
    problem, x = _Problem(evidence, before), start
    for _ in range(_ROUNDS):
        at = require("scipy.optimize").least_squares(
            problem.residuals,
            x,
            problem.jacobian,
            unknowns.bounds,
            loss="soft_l1",  # bears motions in which a contact slipped
            xtol=1e-3,
            ftol=1e-3,
            max_nfev=12,
        )
        x, last = at.x, problem.noise.copy()
        problem.estimate_noise(x)
        if np.abs(np.log(problem.noise / last)).max() < _SETTLED:
            break
    after = problem.at(x)
    covariance: Array = np.linalg.inv(problem.information(x) + np.eye(len(x))).astype(np.float64)
    return Calibration(
        model=model,
        unknowns=unknowns,
        x=x,
        covariance=covariance,
        errors_before=before.motion,
        errors_after=after.motion,
        noise=problem.deviations(),
    )


class _Problem:
    """The residuals as scipy wants them, each point computed once, the priors as last rows."""

    def __init__(self, evidence: Evidence, start: Residuals) -> None:
        self.evidence, self.noise = evidence, np.ones(len(GROUPS))
        self.size = len(start.value)
        self._key: Array | None = None
        self._last = start

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

    def deviations(self) -> dict[str, float]:
        """Estimated standard deviations [rad, m, N m, N]."""
        found = {name: float(s * self.noise[k]) for k, (name, s) in enumerate(GROUPS.items())}
        scale = found.pop("equilibrium")
        options = self.evidence.model.options.forces
        return {**found, "torque": scale * options.torque_std, "force": scale * options.normal_std}

    def estimate_noise(self, x: Array) -> None:
        """Standard deviation of each kind of residual; those of motions by the median, since contacts slip.

        Rows that no parameter moves (out of a planar hand's plane) say nothing. The parameters take their
        share of the freedom, as far as the data and not the priors determine them.
        """
        at, sensors = self.at(x), self.evidence.sensors
        moved = np.abs(at.jacobian).max(axis=1) > 1e-9
        values = np.linalg.eigvalsh(self.information(x))
        freedom = float(np.sum(values / (1 + values)))
        share = max(0.1, 1 - freedom / max(1, moved.sum()))
        for k, name in enumerate(GROUPS):
            own = at.value[(at.group == k) & moved]
            if name == "equilibrium":
                # each state has as many equations to spare as it has sensors; the rest the forces fit exactly
                noise = float(np.sqrt(own @ own / sensors)) if sensors else _UNSENSED
            elif not own.size:
                continue
            elif name == "encoder":
                noise = float(np.sqrt(np.mean(own**2)))
            else:
                noise = 1.4826 * float(np.median(np.abs(own)))
            self.noise[k] = max(_SMALLEST_NOISE, noise / share**0.5)
