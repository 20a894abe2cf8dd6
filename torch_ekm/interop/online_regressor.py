"""A learner on numpy rows, where no model is at hand but the first target."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch.distributions import Normal

from ..exceptions import ParameterError, StateError
from ..residual import ResidualLearner, default_learner
from ..typing import Array

#: A learner, ``factory(in_features, out_features)``, or None for the package's default.
LearnerLike = ResidualLearner | Callable[[int, int], ResidualLearner] | None


class OnlineRegressor:
    """``y = c + g(x) + noise``: c the first target, g the learner.

    A learner starts at 0 and so expects what some model leaves over. Where there is none, the first target is
    the model: a mean that moved would make g another function at each sample. Other libraries' interfaces
    stand on this one.

    Args:
        learner: of (in, out), untrained; it belongs to the regressor from now on.
    """

    def __init__(self, learner: ResidualLearner) -> None:
        self.learner = learner
        self.first: Array | None = None

    def learn(self, x: Array, y: Array) -> None:
        """One sample, ``(in,)`` and ``(out,)``.

        Raises:
            ShapeError: a width does not fit.
            NonFiniteError: NaN or infinity. Nothing is changed.
        """
        first = np.array(y, dtype=float) if self.first is None else self.first
        self.learner.update(torch.tensor(x, dtype=torch.float64), torch.from_numpy(y - first))
        if np.isfinite(first).all():  # a learner that leaves bad samples out takes a NaN without an error
            self.first = first

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (noise included) of y, each ``(n, out)``, at x ``(n, in)``."""
        with torch.no_grad():
            law = self.learner.predict(torch.tensor(x, dtype=torch.float64), observation=True)
        first = 0.0 if self.first is None else self.first
        return first + law.mean.double().cpu().numpy(), law.stddev.double().cpu().numpy()

    def interval(self, x: Array, level: float = 0.95) -> tuple[Array, Array]:
        """Central interval that is to hold ``level`` of the samples, as (low, high), each ``(n, out)``.

        Raises:
            ParameterError: the level is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise ParameterError("level", level, "between 0 and 1, such as 0.95")
        mean, deviation = self.predict(x)
        half = float(Normal(0.0, 1.0).icdf(torch.tensor(0.5 + 0.5 * level, dtype=torch.float64))) * deviation
        return mean - half, mean + half


def make_learner(learner: LearnerLike, in_features: int, out_features: int) -> ResidualLearner:
    """A fresh learner of these sizes: a copy of the one given, or what the factory makes.

    Raises:
        StateError: it has other sizes, or is a fleet.
    """
    if isinstance(learner, ResidualLearner):
        made = copy.deepcopy(learner)
    else:
        own = partial(default_learner, output_offset="learned")  # targets are nobody's residual
        made = (learner or own)(in_features, out_features)
    sizes = made.in_features, made.out_features, tuple(made.batch_shape)
    if sizes != (in_features, out_features, ()):
        needed = f"needed is one model of {in_features} inputs and {out_features} outputs"
        raise StateError(
            f"the learner has {sizes[0]} inputs, {sizes[1]} outputs, batch shape {sizes[2]}; {needed}"
        )
    return made
