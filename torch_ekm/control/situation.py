"""What the rows of tasks and limits are made from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..enhanced import EnhancedModel
from ..kinematics import GraspState
from ..typing import Float, Tensor
from .focus import FocusedPose
from .qp import Array, as_array

if TYPE_CHECKING:
    from ..description import HandDescription
    from ..model import Linearization


@dataclass(frozen=True)
class Situation:
    """What was seen and what is wanted, the same for all iterations of a decision."""

    hand: HandDescription
    focus: FocusedPose
    state: GraspState
    a: Float[Tensor, " n_a"]
    """Encoders [rad]."""
    fingertip_force: Float[Tensor, " n_pads"] | None
    """Measured normal force of each pad [N], NaN where unknown; None: no pad measures."""
    error: Float[Tensor, " 6"]
    """e, the twist to the target [m, rad]."""
    desired: Float[Tensor, " n_x"]
    """dx_d, what one step shall do to the focused pose."""
    joint_force: Float[Tensor, " n_c"] | None = None
    """Normal force of each contact by joints and springs alone [N], where they contradict the pads."""
    weight: float = 0.0
    """Of the object [N]."""
    tighter: float = 0.0
    """Wanted on top of the grip that suits the object [N]."""
    drift: Array | None = None
    """By which the normal forces change as the object turns by :attr:`desired`, whatever the motors do [N];
    None: 0."""
    bend: Float[Tensor, " n_s"] | None = None
    """c of ``f(s, u) ~ J u + c`` about a motion that is not small, J that of the linearization; None: 0."""
    grip: float | None = None
    """Wanted of the finger that opposes the others, see :class:`GripForceTask` [N]; None: nothing."""

    def drift_of(self, contacts: list[int]) -> Array:
        """:attr:`drift` of some of the contacts."""
        return np.zeros(len(contacts)) if self.drift is None else self.drift[contacts]

    def pads(self, kinematic: Linearization) -> list[int]:
        """Which contacts are pads'; the others are links without one."""
        return self.hand.pad_rows(kinematic.contacts.finger)[0]

    def normal_force(self, kinematic: Linearization) -> Array | None:
        """``f_n`` of each contact [N]: as its pad measures it, or else as the model estimates it.

        None: nothing is measured, and the model finds no forces either.
        """
        estimated = as_array(kinematic.forces.normal) if kinematic.forces.solved else None
        if self.fingertip_force is None:
            return estimated
        rows, pads = self.hand.pad_rows(kinematic.contacts.finger)
        measured = np.full(len(kinematic.contacts.finger), np.nan)  # of a link without a pad
        measured[rows] = as_array(self.fingertip_force)[pads]
        return np.where(np.isnan(measured), 0.0 if estimated is None else estimated, measured)


def grip_shares(f_n: Array, grip: float) -> Array:
    """What is wanted of each finger ``(n_c,)`` [N]: the one that presses most opposes all that share.

    Args:
        f_n: normal forces [N].
        grip: of the finger that opposes the others [N].
    """
    wanted = np.full(len(f_n), grip / max(len(f_n) - 1, 1))
    wanted[f_n.argmax()] = grip
    return wanted


@dataclass(frozen=True)
class LinearizedModel:
    """``(f + g)(s, u) ~ offset + jacobian u`` near one action."""

    kinematic: Linearization
    """f alone, with its contacts and forces and how they answer to the actuators."""
    offset: Float[Tensor, " n_s"]
    jacobian: Float[Tensor, "n_s n_a"]
    """Rows: joints [rad/rad], object point [m/rad], object rotation [rad/rad]."""

    @classmethod
    def about(
        cls,
        action: Float[Tensor, " n_a"],
        kinematic: Linearization,
        enhanced: EnhancedModel | None = None,
        bend: Float[Tensor, " n_s"] | None = None,
    ) -> LinearizedModel:
        """``(f + g)(a + d) ~ value + J d = (value - J a) + J (a + d)`` about one action a."""
        J = kinematic.manipulation_jacobian
        offset = J.new_zeros(len(J)) if bend is None else bend
        if enhanced is not None:
            value, J = enhanced.linearize(kinematic.state, action, J)
            offset = offset + value - J @ action
        return cls(kinematic, offset, J)
