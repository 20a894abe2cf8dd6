"""What a step should do: each wish is a class with its figures and ``rows``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import torch

from .._checks import check_positive
from .._noise import DEGREE
from .limits import contact_travel
from .qp import Equality, Squares, as_array
from .situation import LinearizedModel, Situation, grip_shares

if TYPE_CHECKING:
    from ..model import Linearization

_UNMEASURED = 2.0  # [N]


@runtime_checkable
class Task(Protocol):
    """What a step should do. One of your own needs no more than this method.

    One that also says how hard the finger that opposes the others is to press, ``wanted(kinematic, seen)``
    [N], takes the place of :class:`GripForceTask`.
    """

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares | Equality | None:
        """Rows in ``u = da`` [rad]; None: nothing is asked for here."""
        ...


@dataclass(frozen=True)
class FocusTask:
    """``D M_c E_p (f + g)(s, u) + sl = D dx_d``: the step meets the limited error if it can, else comes as
    near as it can (exact l1 slack). D is the ``tolerance_scale`` of the :class:`FocusedPose`."""

    penalty: float = 1e3
    """rho, per degree of a focused rotation that is left unmet."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Equality:
        focus, n_q = seen.focus, model.kinematic.n_q
        M, scale = focus.matrix, focus.tolerance_scale
        left = seen.desired - M @ model.offset[n_q:]
        A = scale[:, None] * (M @ model.jacobian[n_q:])
        return Equality(A, scale * left, self.penalty)


@dataclass(frozen=True)
class OffAxisTask:
    """The object stays where it is, and comes back, in the directions that the focus leaves free."""

    rotation_weight: float = 4.0
    """Per deg^2."""
    translation_weight: float = 0.2
    """Per mm^2; with a quarter of it an object that is turned there and back creeps farther along the grip,
    with five times as much a pad that slides holds a turn back."""
    rotation_step: float = 1.0 * DEGREE
    translation_step: float = 0.5e-3
    """How much of the error is corrected in one step: [rad], [m]."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares:
        off, translation, n_q = seen.focus.off_matrix, seen.focus.off_translation, model.kinematic.n_q
        step = torch.where(translation, self.translation_step, self.rotation_step).to(off.dtype)
        wanted = (off @ seen.error).clamp(-step, step) - off @ model.offset[n_q:]
        weight = torch.where(translation, self.translation_weight, self.rotation_weight)
        unit = torch.where(translation, 1e-3, DEGREE).to(off.dtype)
        return Squares(off @ model.jacobian[n_q:], wanted, weight, unit)


@dataclass(frozen=True)
class GripForceTask:
    """``f_n + (df_n/da) u + d = f``: f_n as the fingertips measure it, only its sensitivity by the model,
    corrected by what was learned of it; d is what the last motions left.

    A grip force that a wrong model computes may drop the object; without fingertip sensors there is no other.

    The finger that presses most opposes all others: it is regulated to ``force``, and the others to
    equal shares of it, so that no finger is left without a grip.

    The grip follows from the object: each side bears half the weight and what turning asks for, which grows
    with the lever r of the contacts about the axis, with a ``1/safety`` of its friction::

        f = clip(safety/mu (m g/2 + turning_load r), least, most)

    Where no pad measures, 2 N more are wanted than that: estimates of single fingers are wrong by 1 N, and
    one that bears less than it seems to lets a heavy object turn off the axis.
    """

    force: float | None = None
    """[N]; None: by the object."""
    safety: float = 2.5
    turning_load: float = 95.0
    """Tangential force for each metre of the lever [N/m]."""
    least: float = 5.0
    """[N]"""
    most: float = 8.5
    """[N]; also of a grip that was tightened."""
    weight: float = 4.0
    """Per N^2."""
    step: float = 0.7
    """At most this much of an error is corrected in one step [N]."""

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares | None:
        f_n = seen.normal_force(model.kinematic)
        if f_n is None:
            return None
        pads = seen.pads(model.kinematic)
        grip = self.wanted(model.kinematic, seen) if seen.grip is None else seen.grip
        wanted = grip_shares(f_n[pads], grip)
        change = np.clip(wanted - f_n[pads], -self.step, self.step) - seen.drift_of(pads)
        return Squares(as_array(model.kinematic.normal_force_sensitivity)[pads], change, self.weight)

    def wanted(self, kinematic: Linearization, seen: Situation) -> float:
        """f, of the finger that opposes the others [N]."""
        if self.force is not None:
            return min(self.force + seen.tighter, max(self.force, self.most))
        contacts = kinematic.contacts
        mu, arms = max(float(contacts.friction.mean()), 1e-3), contacts.point - seen.state.position
        turning = (row for row in seen.focus.matrix if bool(row[3:].any()))
        lever = max((contact_travel(row, arms) for row in turning), default=0)
        force = self.safety / mu * (seen.weight / 2 + self.turning_load * lever)
        more = seen.tighter + (_UNMEASURED if seen.fingertip_force is None else 0.0)
        return min(max(force, self.least) + more, self.most)


@dataclass(frozen=True)
class EffortTask:
    """``w u^T u``: of the steps that do as well, the smallest. It makes the best step unique.

    Raises:
        ParameterError: w is not positive.
    """

    weight: float = 1e-2
    """w, the diagonal of the paper's W; per deg^2 of an actuator."""

    def __post_init__(self) -> None:
        check_positive("weight", self.weight)

    def rows(self, model: LinearizedModel, seen: Situation) -> Squares:
        n_a = len(seen.a)
        return Squares(np.eye(n_a), np.zeros(n_a), self.weight, DEGREE)


#: What a step should do by default: effort, off-axis motion, grip force, focus. The figures suit the iCub
#: hand.
DEFAULT_TASKS: tuple[Task, ...] = (EffortTask(), OffAxisTask(), GripForceTask(), FocusTask())
