from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ..kinematics.grasp_state import GraspState
from ..typing import Float, Tensor
from .configuration import Configuration

if TYPE_CHECKING:
    from ..contact.contact_set import ContactSet
    from ..model import Linearization
    from ..model.grasp_forces import GraspForces

SLIP = 1e-3
"""What a friction margin must lack before it counts as slip [N]: the force problem is solved to less."""


@dataclass(frozen=True)
class Prediction:
    """``z_0, z_1 .. z_K``: the grasp before and after each of K motions, hand frame."""

    actions: Float[Tensor, "*batch K n_a"]
    """Increments of the encoders [rad]."""
    linearization: Linearization = field(repr=False)
    """Of f at all ``K + 1`` configurations, ``(*batch, K + 1, ...)``."""
    variance: Float[Tensor, "*batch nodes n_s"]
    """``(sum_k sd_k)^2`` of the state [rad^2, m^2, rad^2], ``sd_k^2 = Var[g]`` of motion k: g is wrong alike
    in motions that follow each other, and their deviations add up. 0 without a learner."""

    @property
    def states(self) -> GraspState:
        """Joint angles [rad] and object poses [m] before and after each motion, ``(*batch, K + 1, ...)``."""
        return self.linearization.state

    @property
    def contacts(self) -> ContactSet:
        """Rolled along, ``(*batch, K + 1, n_c, ...)``."""
        return self.linearization.contacts

    @property
    def forces(self) -> GraspForces:
        """``(*batch, K + 1, ...)``, as long as contacts stick."""
        return self.linearization.forces

    @property
    def normal_force(self) -> Float[Tensor, "*batch nodes n_c"]:
        """f_n [N]; below 0 the contact would have to pull."""
        return self.forces.normal

    @property
    def margin(self) -> Float[Tensor, "*batch nodes n_c"]:
        """``mu_s f_n - |f_t|`` [N]; below 0 the contact slips, and what follows is no longer true."""
        return self.forces.margin

    @property
    def stability(self) -> Float[Tensor, "*batch nodes"]:
        """Smallest eigenvalue of the stiffness with locked actuators [N m/rad]; below 0 the grasp buckles."""
        return self.linearization.stability

    @property
    def first_slip(self) -> int | None:
        """Index of the first configuration, of all sequences, with a margin below 0; None: nothing slips."""
        slips = (self.margin < -SLIP).any(-1).nonzero()[:, -1]
        return int(slips.min()) if len(slips) else None

    def at(self, k: int) -> Configuration:
        """State, contacts and forces after k motions; -1: after the last."""
        return Configuration.of(self.linearization).select(k)

    @property
    def end(self) -> GraspState:
        """Joint angles [rad] and object pose [m] after the last motion, hand frame."""
        return self.at(-1).state

    def turned(self, matrix: Float[Tensor, "n_x 6"]) -> Float[Tensor, "*batch nodes n_x"]:
        """``M_c xi_k`` of the twist from the start to each state [m, rad]."""
        s = self.states
        start = GraspState(s.q[..., :1, :], s.position[..., :1, :], s.rotation[..., :1, :, :])
        return s.minus(start)[..., -6:] @ matrix.mT
