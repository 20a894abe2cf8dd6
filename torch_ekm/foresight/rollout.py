from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import torch

from .._checks import check_finite
from ..contact.contact_set import ContactSet
from ..enhanced import EnhancedModel
from ..enhanced.enhanced_model import kinematic_and_enhanced
from ..exceptions import ShapeError
from ..kinematics.grasp_state import GraspState
from ..kinematics.tensors import as_tensors
from ..typing import Float, Tensor
from .configuration import Configuration, change, moved, settled, stack
from .prediction import Prediction

if TYPE_CHECKING:
    from ..model import KinematicModel, Linearization


class Rollout:
    """``z' = z (+) (dz/da)(z_m) w``, ``z_m = z (+) (dz/da)(z) w/2``: the midpoint rule, motion after motion.

    z is state, contacts and forces. f is taken half a motion later; g, which was learned of whole motions, at
    their beginnings: ``ds = J_m(s_m) w + g(s, w)``. Contacts roll along; no collision query is made on the
    way. Forces are those of contacts that stick throughout a motion; a contact that was asked for more than
    its cone begins the next motion on it.

    Args:
        model: a kinematic model, or an enhanced one around it.
    """

    def __init__(self, model: KinematicModel | EnhancedModel) -> None:
        self.kinematic, self.enhanced = kinematic_and_enhanced(model)

    def predict(
        self,
        state: GraspState,
        actions: Float[Tensor, "*batch K n_a"],
        contacts: ContactSet | None = None,
        fingertip_force: Float[Tensor, " n_pads"] | None = None,
        *,
        start: Linearization | None = None,
    ) -> Prediction:
        """What the motions do, one after the other. Differentiable in state and actions.

        Args:
            state: one state, or ``(*batch)`` of them together with batched ``contacts``.
            actions: increments of the encoders [rad]; any batch of sequences.
            contacts: at the beginning; by default from the detector (a single state).
            fingertip_force: normal forces there [N], in the order of ``hand.pads``, NaN where unknown.
            start: in place of both: the model linearized at ``state``, with the forces that are known there.

        Raises:
            ShapeError: actions do not fit the hand, or not the batch of states.
            NonFiniteError: an entry is NaN or infinite.
            GraspError: what :meth:`KinematicModel.linearize` raises at the start, and
                :class:`SingularGraspError` on the way. A grasp that buckles on the way has a negative
                ``stability``.
        """
        (actions,) = as_tensors(actions=actions)
        n_a = self.kinematic.hand.n_a
        if actions.dim() < 2 or actions.shape[-1] != n_a:
            raise ShapeError("actions", f"(*batch, K, {n_a})", actions.shape, "one entry per actuator")
        check_finite("actions", actions)
        first = start
        if first is None:
            first = self.kinematic.linearize(
                state, contacts, fingertip_force=fingertip_force, on_unstable="flag"
            )
        batch = actions.shape[:-2]
        try:
            z = Configuration.of(first).expand(*batch)
        except RuntimeError as error:
            shape = tuple(first.state.q.shape[:-1])
            raise ShapeError("actions", f"({', '.join(map(str, shape))}, K, {n_a})", actions.shape) from error
        still = actions.new_zeros(*batch, z.state.n_s)
        way, variance = [z], [still]
        for action in actions.unbind(-2):
            z, unsure = self._motion(z, action)
            way.append(z)
            variance.append(unsure)
        every = stack(way)
        lin = dataclasses.replace(self._linearize(settled(every)), forces=every.forces)
        deviation = torch.stack(variance, dim=-2).sqrt().cumsum(-2)
        return Prediction(actions, lin, deviation.square())

    def _motion(self, z: Configuration, action: Tensor) -> tuple[Configuration, Tensor]:
        """One motion by the midpoint rule, and the learner's variance of it."""
        g, variance = self._correction(z.state, action)
        z = settled(z)
        dz = change(self._linearize(z), self._contacts(z), action / 2, g / 2)
        middle = settled(moved(self.kinematic, z, dz))
        dz = change(self._linearize(middle), self._contacts(middle), action, g)
        return moved(self.kinematic, z, dz), variance

    def _linearize(self, z: Configuration) -> Linearization:
        return self.kinematic.linearize(z.state, z.contacts, forces=z.forces, on_unstable="flag")

    def _contacts(self, z: Configuration):
        return self.kinematic.contact_kinematics(z.state, z.contacts)

    def _correction(self, state: GraspState, action: Tensor) -> tuple[Tensor, Tensor]:
        """``g(s, w)`` and its variance, as increments of the state."""
        if self.enhanced is None:
            still = action.new_zeros(*action.shape[:-1], state.n_s)
            return still, still
        return self.enhanced.correction(state, action, state.n_s)
