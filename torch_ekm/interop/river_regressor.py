"""Learners as regressors of river (extra ``interop``)."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator
from typing import Any

import numpy as np

from .._extras import require
from ..exceptions import ShapeError
from ..residual import ResidualLearner
from ..typing import Array
from .online_regressor import LearnerLike, OnlineRegressor, make_learner

base = require("river.base", "interop")


class RiverRegressor(base.Regressor):
    """``y = c + g(x)``, c the first target, g a learner: a regressor of river.

    Features get columns of x in the order in which they come (those of one sample by name); one that is
    missing is put at its mean so far. Before the first sample the prediction is None, which river does not
    score. Several targets: ``river.multioutput.RegressorChain`` of it.

    Args:
        learner: untrained, of one output, whose ``in_features`` is the number of features; the stream may
            not have more. Or ``factory(in_features, out_features)``, None for the default: it is then made
            for the features of the first sample, and later ones are left out.
    """

    def __init__(self, learner: LearnerLike = None) -> None:
        self.learner = learner
        self._regressor: OnlineRegressor | None = None
        self._places: dict[Hashable, int] = {}
        self._means = self._counts = np.zeros(0)

    def learn_one(self, x: dict, y: float) -> None:
        """Learn one sample: features x by name, and y.

        Raises:
            ShapeError: with it the stream has more features than the learner that was given.
        """
        if self._regressor is None:
            width = self.learner.in_features if isinstance(self.learner, ResidualLearner) else max(len(x), 1)
            self._regressor = OnlineRegressor(make_learner(self.learner, width, 1))
            self._means, self._counts = np.zeros(width), np.zeros(width)
        self._give_places(sorted((name for name in x if name not in self._places), key=str))
        self._regressor.learn(self._row(x), np.array([float(y)]))
        for name, value in x.items():
            if (place := self._places.get(name)) is not None and math.isfinite(value):
                self._counts[place] += 1
                self._means[place] += (float(value) - self._means[place]) / self._counts[place]

    def predict_one(self, x: dict) -> float | None:
        """Mean of y at these features; None before the first sample."""
        if self._regressor is None:
            return None
        return float(self._regressor.predict(self._row(x)[None])[0][0, 0])

    def _give_places(self, new: list[Hashable]) -> None:
        free = len(self._means) - len(self._places)
        if isinstance(self.learner, ResidualLearner) and len(new) > free:
            names = [*self._places, *new]
            hint = f"the stream has the features {', '.join(map(str, names))}"
            raise ShapeError("x", f"at most {len(self._means)} features, as the learner", (len(names),), hint)
        for name in new[:free]:
            self._places[name] = len(self._places)

    def _row(self, x: dict) -> Array:
        row = self._means.copy()
        for name, value in x.items():
            if name in self._places:
                row[self._places[name]] = float(value)
        return row

    @classmethod
    def _unit_test_params(cls) -> Iterator[dict[str, Any]]:
        yield {"learner": None}
