"""Learners as regressors of river (extra ``interop``)."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping
from typing import Any

import numpy as np

from .._extras import require
from ..exceptions import ShapeError
from ..residual import ResidualLearner
from ..typing import Array
from .online_regressor import LearnerLike, OnlineRegressor, make_learner

base = require("river.base", "interop")


class _Columns:
    """Features by name as rows of a fixed width; names get columns in the order in which they come.

    A feature that is missing is put at the mean of what it was so far. ``strict``: a name without a column
    is an error; else it is left out.
    """

    def __init__(self, width: int, strict: bool) -> None:
        self.width, self.strict = width, strict
        self.places: dict[Hashable, int] = {}
        self.mean, self.count = np.zeros(width), np.zeros(width)

    def row(self, x: Mapping[Hashable, Any]) -> Array:
        row = self.mean.copy()
        for name, value in x.items():
            if name in self.places:
                row[self.places[name]] = float(value)
        return row

    def assign(self, x: Mapping[Hashable, Any]) -> None:
        """Give columns to new names."""
        new = sorted((name for name in x if name not in self.places), key=str)
        if self.strict and len(self.places) + len(new) > self.width:
            names = [*self.places, *new]
            hint = f"the stream has the features {', '.join(map(str, names))}"
            raise ShapeError("x", f"at most {self.width} features, as the learner", (len(names),), hint)
        for name in new[: self.width - len(self.places)]:
            self.places[name] = len(self.places)

    def follow(self, x: Mapping[Hashable, Any]) -> None:
        """Take the features of a sample that was learned into their means."""
        for name, value in x.items():
            if (place := self.places.get(name)) is not None and math.isfinite(value):
                self.count[place] += 1
                self.mean[place] += (float(value) - self.mean[place]) / self.count[place]


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
        self._columns: _Columns | None = None
        self._regressor: OnlineRegressor | None = None

    def learn_one(self, x: dict, y: float) -> None:
        """Learn one sample: features x by name, and y."""
        if self._regressor is None or self._columns is None:
            given = isinstance(self.learner, ResidualLearner)
            width = self.learner.in_features if isinstance(self.learner, ResidualLearner) else max(len(x), 1)
            regressor = OnlineRegressor(make_learner(self.learner, width, 1))
            self._columns, self._regressor = _Columns(width, given), regressor
        self._columns.assign(x)
        self._regressor.learn(self._columns.row(x), np.array([float(y)]))
        self._columns.follow(x)

    def predict_one(self, x: dict) -> float | None:
        """Mean of y at these features; None before the first sample."""
        if self._regressor is None or self._columns is None:
            return None
        return float(self._regressor.predict(self._columns.row(x)[None])[0][0, 0])

    @classmethod
    def _unit_test_params(cls) -> Iterator[dict[str, Any]]:
        yield {"learner": None}
