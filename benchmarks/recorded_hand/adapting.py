"""The kinematic model from published figures, which adapt online: each sample is predicted, then learned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from torch_ekm.contact.contact_set import VARYING
from torch_ekm.description import HandDescription
from torch_ekm.estimation.hand_figures import HandFigures
from torch_ekm.exceptions import GraspError
from torch_ekm.experiments.learner_comparison.run import repeatable
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, Linearization
from torch_ekm.typing import Array

from .nominal import LARGEST, Samples
from .states import OPTIONS, States, cylinder

_PLANE = [0, 1, 5]  # x, y and angle of an object's twist


def adapting_predictions(
    hand: HandDescription,
    samples: Mapping[str, Samples],
    states: Mapping[str, States],
    usual: Mapping[str, Array],
    order: Sequence[str],
) -> dict[str, Array]:
    """``J_m(theta) w``, ``(n, 3)`` [m, m, rad] of each object; theta is kept over all objects.

    A sample is learned when its horizon is over, which is when the next one begins.

    Args:
        hand: with published figures.
        usual: Jacobians ``(n_states, 3, 2)`` for states in which theirs is not to be believed.
        order: objects in the order in which the hand meets them.
    """
    obj = cylinder(0.045)  # its mass alone counts, and that not in the plane
    figures, found = HandFigures.of(hand), {}
    model = KinematicModel(hand, obj, OPTIONS).with_figures(figures)
    with repeatable():
        for name in order:
            taken, at = samples[name], states[name]
            contacts, grasps, c, s = at.contact_set(obj.friction), at.grasps(), *_turn(at)
            found[name] = np.einsum("nij,nj->ni", usual[name][taken.row], taken.transmitted)
            for k, row in enumerate(taken.row):
                here = GraspState(grasps.q[row], grasps.position[row], grasps.rotation[row])
                touching = contacts.replace(**{field: getattr(contacts, field)[row] for field in VARYING})
                try:
                    lin = model.linearize(here, touching)
                except GraspError:
                    continue
                moved = torch.from_numpy(taken.transmitted[k].astype(np.float64))
                x, y, angle = lin.step(moved)[-6:][_PLANE].tolist()
                if float(lin.object_jacobian[:2].abs().max()) < LARGEST:
                    found[name][k] = c[row] * x - s[row] * y, s[row] * x + c[row] * y, angle
                    figures.learn(lin, moved, _increment(lin, taken, k, at, c[row], s[row]))
    return found


def _turn(states: States) -> tuple[Array, Array]:
    """Of the camera against the hand at each state: cosine and sine."""
    return np.cos(states.camera[:, 0]), np.sin(states.camera[:, 0])


def _increment(
    lin: Linearization, taken: Samples, k: int, states: States, c: float, s: float
) -> torch.Tensor:
    """ds of a sample, hand frame; joints as predicted where no state was found at its end."""
    row, (x, y, angle) = taken.row[k], taken.motion[k].tolist()
    ds = lin.step(torch.from_numpy(taken.transmitted[k].astype(np.float64)))
    ends = np.flatnonzero(
        (states.path == states.path[row]) & (states.step == states.step[row] + taken.horizon)
    )
    if len(ends):
        ds[: lin.n_q] = torch.from_numpy(states.q[ends[0]] - states.q[row])
    ds[-6:] = torch.tensor([c * x + s * y, c * y - s * x, 0.0, 0.0, 0.0, angle], dtype=ds.dtype)
    return ds
