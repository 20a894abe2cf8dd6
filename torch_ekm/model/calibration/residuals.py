"""What measured motions and forces have against a set of figures, and its derivative."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from ..._noise import NOISE
from ...exceptions import GraspError
from ...kinematics.grasp_state import GraspState
from ...kinematics.servo_model import Play
from ...typing import Array, Float, Tensor
from ..kinematic_model import KinematicModel
from ..linearization import Linearization
from .parameters import Figures, Unknowns


@runtime_checkable
class Recording(Protocol):
    """``torch_ekm.plant.Trajectory``, or anything with observations in the order of time.

    Of each observation: ``state``, ``a`` (encoders [rad]), ``fingertip_force`` [N] (NaN, or None as a whole,
    where there is no sensor) and ``status``; what is not "held" ends a grasp.
    """

    @property
    def observations(self) -> Sequence[Any]: ...


@dataclass(frozen=True)
class Rest:
    """A state in which hand and object rest, with encoders [rad] and fingertip forces [N]."""

    state: GraspState
    a: Float[Tensor, " n_a"]
    force: Float[Tensor, " n_pads"] | None


def rests(recordings: Iterable[Recording]) -> list[list[Rest]]:
    """The states of each grasp, in order; a state in which the object is not held or not seen ends one."""
    grasps: list[list[Rest]] = []
    for recording in recordings:
        grasp: list[Rest] = []
        for seen in recording.observations:
            if getattr(seen.status, "value", seen.status) != "held":
                grasps.append(grasp)
                grasp = []
                continue
            force = None if seen.fingertip_force is None else seen.fingertip_force.double()
            if force is not None and not bool(torch.isfinite(force).any()):
                force = None
            state = GraspState(*(part.double() for part in (seen.q, seen.position, seen.rotation)))
            grasp.append(Rest(state, seen.a.double(), force))
        grasps.append(grasp)
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


_SLACK = 1e-3  # [N m] a tendon with less has no length to compare


class Residuals(NamedTuple):
    """Residuals of all motions and equilibria at one set of figures."""

    value: Array
    """``(n_r,)``, in units of :data:`GROUPS`."""
    jacobian: Array
    """By x, ``(n_r, n)``; empty if not asked for."""
    group: NDArray[np.intp]
    """Index into :data:`GROUPS`, ``(n_r,)``."""
    motion: Array
    """Errors of predicted increments ``[dq; do; dphi]``, ``(n_motions, n_s)`` [rad, m, rad]."""


class Evidence:
    """Residuals of motions and equilibria of all grasps.

    ```
    ds - 1/2 (J_m(s) + J_m(s+)) dx,  dx = play(da)     motion; the mean of both ends is exact to second order
    e(s),  f_n(s) - measured                           equilibrium: from the force problem of the model
    a + z - a0 - J_a q + lam/K_a                       encoders of the actuators whose offset is an unknown
    ```

    States at which the description finds no forces, and motions from or to them, are left out for good.

    Args:
        model: of the hand as described.
        grasps: from :func:`~torch_ekm.model.calibration.residuals.rests`.
        unknowns: what x means.
    """

    def __init__(self, model: KinematicModel, grasps: list[list[Rest]], unknowns: Unknowns) -> None:
        # a guess of the tangential forces would pull at the figures
        forces = dataclasses.replace(model.options.forces, start_std=100.0)
        options = dataclasses.replace(model.options, on_unstable="flag", forces=forces)
        self.model = KinematicModel(
            model.hand, model.obj, options, kinematics=model.kinematics, detector=model.detector
        )
        self.grasps, self.unknowns = grasps, unknowns
        self.with_offset = [p.index[0] for p in unknowns.parameters if p.kind == "offset"]
        self._set(unknowns.nominal)
        self.usable = [[self._found(rest) for rest in grasp] for grasp in grasps]

    @property
    def sensors(self) -> int:
        """How many fingertip forces were measured, in all usable states."""
        return sum(
            int(torch.isfinite(rest.force).sum())
            for grasp, usable in zip(self.grasps, self.usable, strict=True)
            for rest, one in zip(grasp, usable, strict=True)
            if one and rest.force is not None
        )

    def __call__(self, x: Array, *, jacobian: bool = True) -> Residuals:
        """Residuals at x.

        Raises:
            GraspError: a state cannot be modelled with these figures.
        """
        at = torch.from_numpy(np.array(x, dtype=np.float64)).requires_grad_(jacobian)
        figures = self.unknowns.figures(at)
        self._set(figures)
        values, slopes, groups, motions = [], [], [], []
        with torch.set_grad_enabled(jacobian):
            for parts, motion in self._rows(figures):
                r = torch.cat(list(parts.values()))
                if jacobian:
                    slopes.append(_jacobian(r, at))
                values.append(r.detach().numpy())
                groups += [list(GROUPS).index(name) for name, part in parts.items() for _ in part]
                if motion is not None:
                    motions.append(motion.detach().numpy())
        slope = np.concatenate(slopes) if jacobian else np.zeros((0, len(x)))
        n_s = self.model.hand.n_q + 6
        return Residuals(np.concatenate(values), slope, np.array(groups), np.array(motions).reshape(-1, n_s))

    def _rows(self, figures: Figures) -> Iterator[tuple[dict[str, Tensor], Tensor | None]]:
        play = Play(figures.backlash)
        for grasp, usable in zip(self.grasps, self.usable, strict=True):
            state, last = play.unknown(), None
            for k, rest in enumerate(grasp):
                lin = self._linearize(rest) if usable[k] else None
                dx = torch.zeros(0)
                if k:
                    dx, state = play.advance(state, rest.a - grasp[k - 1].a)
                parts, motion = {}, None
                if lin is not None:
                    parts = self._equilibrium(lin, rest)
                    if self.with_offset:
                        parts |= self._encoders(lin, rest, state.position, figures)
                    if last is not None:
                        measured = rest.state.minus(grasp[k - 1].state)
                        motion = measured - 0.5 * (last.step(dx) + lin.step(dx))
                        moving = motion[: self.model.hand.n_q][self.model.moving(lin.contacts)]
                        do, dphi = motion[-6:].split(3)
                        parts |= _scaled(joints=moving, position=do, rotation=dphi)
                if parts:
                    yield parts, motion
                last = lin

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


def _scaled(**parts: Tensor) -> dict[str, Tensor]:
    return {name: part / GROUPS[name] for name, part in parts.items()}


def _jacobian(r: Tensor, x: Tensor) -> Array:
    if not r.requires_grad:
        return np.zeros((len(r), len(x)))
    eye = torch.eye(len(r), dtype=r.dtype)
    (slope,) = torch.autograd.grad(r, x, eye, retain_graph=True, is_grads_batched=True, allow_unused=True)
    return slope.numpy()
