"""Least squares from measured motions to the figures of a hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ..._extras import require
from ..._noise import NOISE
from ...exceptions import GraspError, StateError
from ...kinematics.poses import GraspState
from ...kinematics.servo_model import Play
from ...typing import Array, Float, Tensor
from ..kinematic_model import KinematicModel
from ..linearization import Linearization
from .parameters import Calibration, Figures, Unknowns

_SMALLEST_NOISE = 1e-3  # of the standard deviations at the start: below, the model's own error is left
_UNSENSED = 0.5  # of the force problem's standard deviations, where no sensor measures their scale
_INSIDE = 0.1  # [priors] of its bound a search begins
_ROUNDS, _SETTLED = 8, 0.2  # of estimating the noise, at most; relative change at which it is known
_SLACK = 1e-3  # [N m] a tendon with less has no length to compare


def calibrate(
    model: KinematicModel,
    recordings: Iterable[Any],
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
        recordings: trajectories of it, say 30 motions of 1 to 3 deg in several grasps:
            ``torch_ekm.plant.Trajectory``, or anything with ``observations`` in the order of time. Of each:
            ``q``, ``position``, ``rotation``, ``a`` (encoders [rad]), ``fingertip_force`` [N] (NaN, or None
            as a whole, where there is no sensor) and ``status``; what is not "held" ends a grasp. The
            encoders' readings give the increments, so the faults of a position controller do no harm.
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
    if not any(one and other for usable in evidence.usable for one, other in pairwise(usable)):
        needed = "motions between two successive states in which the object is held and its forces are found"
        raise StateError(f"no motion of the recordings can be used; needed are {needed}")
    before = evidence.at(nominal)
    x = np.maximum(nominal, unknowns.bounds[0] + _INSIDE)  # no derivative leads off a bound
    for _ in range(_ROUNDS):
        found = require("scipy.optimize").least_squares(
            evidence.residuals,
            x,
            evidence.jacobian,
            unknowns.bounds,
            loss="soft_l1",  # bears motions in which a contact slipped
            xtol=1e-3,
            ftol=1e-3,
            max_nfev=12,
        )
        x, last = found.x, evidence.noise.copy()
        evidence.estimate_noise(x)
        if np.abs(np.log(evidence.noise / last)).max() < _SETTLED:
            break
    return Calibration(
        model=model,
        unknowns=unknowns,
        x=x,
        covariance=np.linalg.inv(evidence.information(x) + np.eye(len(x))).astype(np.float64),
        errors_before=before.motion,
        errors_after=evidence.at(x).motion,
        noise=evidence.deviations(),
    )


@dataclass(frozen=True)
class Rest:
    """A state in which hand and object rest, with encoders [rad] and fingertip forces [N]."""

    state: GraspState
    a: Float[Tensor, " n_a"]
    force: Float[Tensor, " n_pads"] | None


def rests(recordings: Iterable[Any]) -> list[list[Rest]]:
    """The states of each grasp, in order; a state in which the object is not held or not seen ends one."""
    grasps: list[list[Rest]] = []
    for recording in recordings:
        grasps.append([])
        for seen in recording.observations:
            if getattr(seen.status, "value", seen.status) != "held":
                grasps.append([])
                continue
            force = None if seen.fingertip_force is None else seen.fingertip_force.double()
            if force is not None and not bool(torch.isfinite(force).any()):
                force = None
            state = GraspState(*(part.double() for part in (seen.q, seen.position, seen.rotation)))
            grasps[-1].append(Rest(state, seen.a.double(), force))
    return [grasp for grasp in grasps if len(grasp) > 1]


GROUPS = {
    "joints": NOISE.joint,
    "position": NOISE.position,
    "rotation": NOISE.rotation,
    "encoder": NOISE.joint,
    "equilibrium": 1.0,
}
"""Standard deviations at the start: of a measured motion [rad], [m], [rad], of an encoder against joints and
tension [rad]; of joint torques and fingertip forces in units of those by which the force problem weighs them
(it trades one for the other, so that neither can be estimated by itself). They are estimated
again from the residuals."""


class Residuals(NamedTuple):
    """Residuals of all motions and equilibria at one set of figures."""

    value: Array
    """``(n_r,)``, in units of :data:`GROUPS`."""
    jacobian: Array
    """By x, ``(n_r, n)``."""
    group: NDArray[np.intp]
    """Index into :data:`GROUPS`, ``(n_r,)``."""
    motion: Array
    """Errors of predicted increments ``[dq; do; dphi]``, ``(n_motions, n_s)`` [rad, m, rad]."""


class Evidence:
    """Residuals of motions and equilibria of all grasps, as scipy wants them: over their noise, the priors as
    last rows.

    ```
    ds - 1/2 (J_m(s) + J_m(s+)) dx,  dx = play(da)     motion; the mean of both ends is exact to second order
    e(s),  f_n(s) - measured                           equilibrium: from the force problem of the model
    a + z - a0 - J_a q + lam/K_a                       encoders of the actuators whose offset is an unknown
    ```

    States at which the description finds no forces, and motions from or to them, are left out for good.

    Args:
        model: of the hand as described.
        grasps: from :func:`rests`.
        unknowns: what x means.
    """

    _last: Residuals
    """At the x of ``_key``."""

    def __init__(self, model: KinematicModel, grasps: list[list[Rest]], unknowns: Unknowns) -> None:
        # a guess of the tangential forces would pull at the figures
        forces = dataclasses.replace(model.options.forces, start_std=100.0)
        options = dataclasses.replace(model.options, on_unstable="flag", forces=forces)
        self.model = KinematicModel(
            model.hand, model.obj, options, kinematics=model.kinematics, detector=model.detector
        )
        self.grasps, self.unknowns = grasps, unknowns
        self.with_offset = [p.index[0] for p in unknowns.parameters if p.kind == "offset"]
        self.noise = np.ones(len(GROUPS))
        """Estimated standard deviations, in units of those at the start."""
        self._key = b""
        self._set(unknowns.nominal)
        self.usable = [[self._found(rest) for rest in grasp] for grasp in grasps]

    def at(self, x: Array) -> Residuals:
        """Residuals at x; those of the last one are kept.

        Raises:
            GraspError: a state cannot be modelled with these figures.
        """
        if self._key != x.tobytes():
            self._last = self._at(torch.from_numpy(x.copy()).requires_grad_())
            self._key = x.tobytes()
        return self._last

    def _at(self, x: Tensor) -> Residuals:
        figures = self.unknowns.figures(x)
        self._set(figures)
        values, slopes, groups, motions = [], [], [], []
        for parts, motion in self._rows(figures):
            r = torch.cat(list(parts.values()))
            slopes.append(_jacobian(r, x))
            values.append(r.detach().numpy())
            groups += [list(GROUPS).index(name) for name, part in parts.items() for _ in part]
            if motion is not None:
                motions.append(motion.detach().numpy())
        motion = np.array(motions).reshape(-1, self.model.hand.n_q + 6)
        return Residuals(np.concatenate(values), np.concatenate(slopes), np.array(groups), motion)

    def _rows(self, figures: Figures) -> Iterator[tuple[dict[str, Tensor], Tensor | None]]:
        play = Play(figures.backlash)
        for grasp, usable in zip(self.grasps, self.usable, strict=True):
            state, last = play.unknown(), None
            for k, rest in enumerate(grasp):
                dx, motion = torch.zeros(0), None
                if k:
                    dx, state = play.advance(state, rest.a - grasp[k - 1].a)
                before, last = last, self._linearize(rest) if usable[k] else None
                if last is None:
                    continue
                parts = self._equilibrium(last, rest)
                if self.with_offset:
                    parts |= self._encoders(last, rest, state.position, figures)
                if before is not None:
                    measured = rest.state.minus(grasp[k - 1].state)
                    motion = measured - 0.5 * (before.step(dx) + last.step(dx))
                    moving = motion[: self.model.hand.n_q][self.model.moving(last.contacts)]
                    do, dphi = motion[-6:].split(3)
                    parts |= _scaled(joints=moving, position=do, rotation=dphi)
                yield parts, motion

    def _equilibrium(self, lin: Linearization, rest: Rest) -> dict[str, Tensor]:
        parts = [lin.forces.residual[self.model.moving(lin.contacts)] / self.model.options.forces.torque_std]
        if rest.force is not None:
            measured = rest.force[self.model.hand.pad_indices(lin.contacts.finger)]
            known = torch.isfinite(measured)
            parts.append((lin.forces.normal - measured)[known] / self.model.options.forces.normal_std)
        return {"equilibrium": torch.cat(parts)}

    def _encoders(self, lin: Linearization, rest: Rest, z: Tensor, at: Figures) -> dict[str, Tensor]:
        lam, actuators = lin.forces.lam, self.model.hand.actuators
        taut = torch.tensor([not actuator.tendon for actuator in actuators]) | (lam < -_SLACK)
        bent = torch.from_numpy(self.model.hand.bent(rest.state.q.numpy()))
        stretch = rest.a + z - at.offset - at.moment_arms @ rest.state.q - bent
        unexplained = taut * (stretch + lam / self.model.reduction.stiffness)
        return _scaled(encoder=unexplained[self.with_offset])

    def _linearize(self, rest: Rest) -> Linearization:
        lin = self.model.linearize(rest.state, fingertip_force=rest.force)
        if not lin.forces.solved:
            raise GraspError(f"no forces balance the object: {lin.forces.status[0].value}")
        return lin

    def _found(self, rest: Rest) -> bool:
        try:
            self._linearize(rest)
        except GraspError:
            return False
        return True

    def _set(self, figures: Figures) -> None:
        self.model.spring_stiffness, self.model.spring_rest = figures.springs, figures.rest
        self.model.reduction.actuation = figures.moment_arms
        if self.model.options.actuator_compliance:
            self.model.reduction.stiffness = figures.stiffness

    def residuals(self, x: Array) -> Array:
        """``[W r; x]``, infinite where a state cannot be modelled: the search then takes a smaller step."""
        try:
            at = self.at(x)
        except GraspError:
            return np.full(len(self._last.value) + len(x), np.inf)
        return np.concatenate([at.value / self.noise[at.group], x])

    def jacobian(self, x: Array) -> Array:
        """``[W J; I]``."""
        at = self.at(x)
        return np.concatenate([at.jacobian / self.noise[at.group, None], np.eye(len(x))])

    def information(self, x: Array) -> Array:
        """Fisher information of the data alone, ``J^T W^2 J``."""
        scaled = self.jacobian(x)[: -len(x)]
        return scaled.T @ scaled

    def deviations(self) -> dict[str, float]:
        """Estimated standard deviations [rad, m, N m, N]."""
        found = {name: float(s * self.noise[k]) for k, (name, s) in enumerate(GROUPS.items())}
        scale = found.pop("equilibrium")
        options = self.model.options.forces
        return {**found, "torque": scale * options.torque_std, "force": scale * options.normal_std}

    def estimate_noise(self, x: Array) -> None:
        """Standard deviation of each kind of residual; those of motions by the median, since contacts slip.

        Rows that no parameter moves (out of a planar hand's plane) say nothing. The parameters take their
        share of the freedom, as far as the data and not the priors determine them.
        """
        at = self.at(x)
        sensors = sum(
            int(torch.isfinite(rest.force).sum())
            for grasp, usable in zip(self.grasps, self.usable, strict=True)
            for rest, one in zip(grasp, usable, strict=True)
            if one and rest.force is not None
        )
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


def _scaled(**parts: Tensor) -> dict[str, Tensor]:
    return {name: part / GROUPS[name] for name, part in parts.items()}


def _jacobian(r: Tensor, x: Tensor) -> Array:
    if not r.requires_grad:
        return np.zeros((len(r), len(x)))
    eye = torch.eye(len(r), dtype=r.dtype)
    (slope,) = torch.autograd.grad(r, x, eye, retain_graph=True, is_grads_batched=True, allow_unused=True)
    return slope.numpy()
