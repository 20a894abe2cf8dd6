"""What is learned online, of a nominal model's errors or of its figures: each sample is predicted first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from torch_ekm.contact.contacts import VARYING
from torch_ekm.description import HandDescription
from torch_ekm.estimation.hand_figures import HandFigures
from torch_ekm.exceptions import GraspError
from torch_ekm.experiments.learner_comparison.prequential import run_prequential
from torch_ekm.experiments.learner_comparison.run import repeatable
from torch_ekm.experiments.learners import learner_factory
from torch_ekm.kinematics import GraspState
from torch_ekm.model import KinematicModel, Linearization
from torch_ekm.typing import Array

from .nominal import LARGEST, Nominal, Samples, action_of
from .states import OPTIONS, States, cylinder

_PLANE = [0, 1, 5]  # x, y and angle of an object's twist


def learned_predictions(
    learner: str,
    nominal: Nominal,
    samples: Mapping[str, Samples],
    states: Mapping[str, States],
    predicted: Mapping[str, Array],
    order: Sequence[str],
    apart: str,
    limit: int | None = None,
) -> dict[str, Array]:
    """Nominal model and learner together, ``(n, 3)`` [m, m, rad] of each object; one learner is kept.

    Input: joint angles, object position, loads and the motion that the model takes, in units of the
    recording set apart; output: what the model leaves, likewise. A sample is learned when its horizon is
    over, which is when the next one begins.

    Args:
        learner: a name of :data:`torch_ekm.experiments.learners.LEARNERS`.
        order: objects in the order in which the learner meets them.
        apart: the object that gives the units; it is not learned from.
        limit: only the first so many samples of each object; the model alone after them.
    """
    centre, scale = _units(_inputs(nominal, samples[apart], states[apart]))
    unit = _spread(samples[apart].motion - predicted[apart])
    found = {name: predicted[name].copy() for name in order}
    with repeatable():
        model = learner_factory(learner)(len(centre), 3)
        for name in order:
            taken = samples[name]
            x = torch.from_numpy((_inputs(nominal, taken, states[name]) - centre) / scale)[:limit]
            left = torch.from_numpy((taken.motion - predicted[name]) / unit)[:limit]
            parts = np.unique(taken.path[:limit], return_counts=True)[1].tolist()
            model.new_sequence()
            found[name][:limit] += unit * run_prequential(model, x, left, parts).mean.numpy()
    return found


def _inputs(nominal: Nominal, samples: Samples, states: States) -> Array:
    at = samples.row
    return np.hstack([states.q[at], states.position[at], samples.loads, action_of(nominal, samples)])


def _units(x: Array) -> tuple[Array, Array]:
    scale = x.std(axis=0)
    return x.mean(axis=0), np.where(scale > 1e-12, scale, 1.0)


def _spread(y: Array) -> Array:
    """Root mean square with outliers cut at the 99 % quantile."""
    size = np.abs(y)
    rms = np.sqrt(np.mean(np.minimum(size, np.quantile(size, 0.99, axis=0)) ** 2, axis=0))
    return np.where(rms > 0, rms, 1.0)


def adapting_predictions(
    hand: HandDescription,
    samples: Mapping[str, Samples],
    states: Mapping[str, States],
    usual: Mapping[str, Array],
    order: Sequence[str],
) -> dict[str, Array]:
    """``J_m(theta) w`` by published figures that adapt, ``(n, 3)`` [m, m, rad] of each object.

    theta is kept over all objects. A sample is learned when its horizon is over, which is when the next one
    begins.

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
