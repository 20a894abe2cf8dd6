"""What a learner makes of a nominal model's errors: it predicts each sample, then learns it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from torch_ekm.experiments.learner_comparison.prequential import run_prequential
from torch_ekm.experiments.learner_comparison.run import repeatable
from torch_ekm.experiments.learners import learner_factory
from torch_ekm.typing import Array

from .nominal import Nominal, Samples, action_of
from .states import States


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
