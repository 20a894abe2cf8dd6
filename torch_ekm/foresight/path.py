"""The same way as a rollout's, for a planner: all its configurations are linearized at once."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from ..contact.contact_kinematics import ContactKinematics
from ..contact.contact_set import SHARED, ContactSet
from ..enhanced import EnhancedModel
from ..kinematics.grasp_state import GraspState
from ..model import GraspForces, KinematicModel, Linearization
from ..typing import Float, Tensor
from .configuration import Configuration, chained, change, moved, settled


@dataclass(frozen=True)
class Rates:
    """dz/da at the N configurations of a path: those before and after K motions, then those amid them."""

    linearization: Linearization
    """``(N, ...)``."""
    contacts: ContactKinematics
    jacobian: Float[Tensor, "K+1 n_s n_a"]
    """``J_m + dg/da`` before and after each motion."""
    actions: Float[Tensor, "K n_a"]
    """w_k of that path [rad]."""
    correction: Float[Tensor, "K n_s"]
    """``g(s_k, w_k)``."""
    slope: Float[Tensor, "K n_s n_a"] | None
    """dg/da; None: nothing is learned."""

    def at(self, k: int) -> Linearization:
        """f before motion k, or after the last."""
        return _tree(self.linearization, lambda x: x[k])


@dataclass(frozen=True)
class Path:
    """A foreseen way of K motions."""

    actions: Float[Tensor, "K n_a"]
    """w_k [rad]."""
    nodes: Configuration
    """Before and after each motion, ``(K + 1, ...)``."""
    middles: Configuration
    """Amid each motion, ``(K, ...)``."""
    increments: Float[Tensor, "K n_s"]
    """ds of each motion [rad, m, rad]."""


class PathModel:
    """Picard's iteration of :class:`Rollout`: ``z_k = z_0 (+) sum_j (dz/da)(m_j) w_j``, m_j of the last path.

    A rollout linearizes at 2 K configurations one after the other; here all of a path are linearized in one
    batch, and the next path is integrated with these rates. Its fixed point is the rollout; each iteration
    takes the error times the share by which the rates change along the way, so a plan, which is made in
    iterations anyhow, needs no inner ones.

    Args:
        kinematic, enhanced: f, and f + g around it, or None.
    """

    def __init__(self, kinematic: KinematicModel, enhanced: EnhancedModel | None) -> None:
        self.kinematic, self.enhanced = kinematic, enhanced

    def linearize(self, path: Path) -> Rates:
        """Rates at all configurations of a path."""
        K = len(path.actions)
        every = settled(joined(path.nodes, path.middles))
        kin = self.kinematic.contact_kinematics(every.state, every.contacts)
        lin = self.kinematic.linearize(every.state, every.contacts, forces=every.forces, on_unstable="flag")
        actions = torch.cat([path.actions, path.actions[-1:]])
        J, g, slope = self._corrected(path.nodes.state, actions, lin.manipulation_jacobian[: K + 1])
        return Rates(lin, kin, J, path.actions, g[:K], None if slope is None else slope[:K])

    def follow(self, start: Configuration, rates: Rates, actions: Float[Tensor, "K n_a"]) -> Path:
        """The way of actions, by the rates of an old path."""
        K = len(actions)
        g = rates.correction
        if rates.slope is not None:
            g = g + (rates.slope @ (actions - rates.actions)[..., None])[..., 0]
        before, amid = slice(0, K), slice(K + 1, 2 * K + 1)
        lin, kin = (_tree(part, lambda x: x[amid]) for part in (rates.linearization, rates.contacts))
        steps = change(lin, kin, actions, g)
        whole = chained(steps, start.contacts, start.forces)
        nodes = joined(start.expand(1), moved(self.kinematic, start, whole))
        lin, kin = (_tree(part, lambda x: x[before]) for part in (rates.linearization, rates.contacts))
        half = change(lin, kin, actions / 2, g / 2)
        middles = moved(self.kinematic, settled(nodes.of_first(before)), half)
        return Path(actions, nodes, middles, steps.ds)

    def steps(
        self,
        z: Configuration,
        lin: Linearization,
        action: Float[Tensor, " n_a"],
        ds: Float[Tensor, " n_s"],
        count: int,
    ) -> tuple[Configuration, Configuration]:
        """Amid and after each of ``count`` equal motions, by the rates before them.

        Args:
            action, ds: of all together, and what f + g predict of it.
        """
        kin, g = self.kinematic.contact_kinematics(z.state, z.contacts), ds - lin.step(action)
        share = torch.arange(1, 2 * count + 1, dtype=action.dtype)[:, None] / (2 * count)
        every = moved(self.kinematic, settled(z), change(lin, kin, share * action, share * g))
        return every.of_first(slice(0, None, 2)), every.of_first(slice(1, None, 2))

    def _corrected(
        self, state: GraspState, actions: Tensor, J: Tensor
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """``J_m + dg/da``, g and dg/da."""
        if self.enhanced is None:
            return J, J.new_zeros(len(actions), J.shape[-2]), None
        value, corrected = self.enhanced.linearize(state, actions, J)
        return corrected, value - (J @ actions[..., None])[..., 0], corrected - J


def continued(rates: Rates, motions: int, share: float) -> Rates:
    """The rest of a plan whose first motion is done: its actions in other motions, and the nearest old rates.

    Args:
        motions: of the new path.
        share: length of its motions, as a share of the old ones'. Beyond the old path it goes on as in the
            last old motion.
    """
    old = rates.actions
    K = len(old)
    at = [1 + share * j for j in range(motions + 1)]
    ends = [min(round(x), K) for x in at]
    order = [min(int(x + share / 2), K - 1) for x in at[:-1]]
    whole = torch.tensor([min(int(x), K - 1) for x in at])
    way = torch.cat([old.new_zeros(1, old.shape[-1]), old.cumsum(0)])
    actions = (way[whole] + (torch.tensor(at, dtype=old.dtype) - whole)[:, None] * old[whole]).diff(dim=0)
    index = [*ends, *(K + 1 + k for k in order)]
    lin, kin = (_tree(part, lambda x: x[index]) for part in (rates.linearization, rates.contacts))
    g, slope = rates.correction[order], None
    if rates.slope is not None:
        slope = rates.slope[order]
        g = g + (slope @ (actions - old[order])[..., None])[..., 0]
    return Rates(lin, kin, rates.jacobian[ends], actions, g, slope)


def _tree(value: Any, pick: Callable[[Tensor], Tensor]) -> Any:
    """``pick`` of every batched tensor in a dataclass of dataclasses; none of them is checked again."""
    changed = copy.copy(value)
    for name, part in vars(value).items():
        if isinstance(part, Tensor):
            if name not in SHARED:
                object.__setattr__(changed, name, pick(part))
        elif isinstance(part, (GraspState, ContactSet, GraspForces)):
            object.__setattr__(changed, name, _tree(part, pick))
    return changed


def joined(first: Configuration, second: Configuration) -> Configuration:
    """One after the other along the first dimension."""

    def join(a: Any, b: Any) -> Any:
        changes = {}
        for field in dataclasses.fields(a):
            one, other = getattr(a, field.name), getattr(b, field.name)
            if field.name in SHARED:
                continue
            if isinstance(one, Tensor):
                changes[field.name] = torch.cat([one, other])
            elif dataclasses.is_dataclass(one):
                changes[field.name] = join(one, other)
            elif field.name == "status":
                changes[field.name] = one + other
        return dataclasses.replace(a, **changes)

    return join(first, second)
