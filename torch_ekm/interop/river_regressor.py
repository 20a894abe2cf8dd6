"""Learners as regressors of river (extra ``interop``)."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .._extras import require
from ..exceptions import ShapeError
from ..residual import ResidualLearner
from ..typing import Array
from .online_regressor import LearnerLike, OnlineRegressor, make_learner

if TYPE_CHECKING:
    from river import base
else:
    base = require("river.base", "interop")


def as_river(learner: LearnerLike = None, targets: int = 1) -> RiverRegressor | RiverMultiTargetRegressor:
    """``y = c + g(x)`` as a regressor of river; a multi-target one if there is more than one output.

    Args:
        learner: untrained; or ``factory(in_features, out_features)``; None: the default.
        targets: how many outputs, where a factory has to know.
    """
    if isinstance(learner, ResidualLearner):
        targets = learner.out_features
    return RiverRegressor(learner) if targets == 1 else RiverMultiTargetRegressor(learner)


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

    def take(self, x: Mapping[Hashable, Any]) -> None:
        """Give columns to new names, and follow the means."""
        new = sorted((name for name in x if name not in self.places), key=str)
        if self.strict and len(self.places) + len(new) > self.width:
            names = [*self.places, *new]
            hint = f"the stream has the features {', '.join(map(str, names))}"
            raise ShapeError("x", f"at most {self.width} features, as the learner", (len(names),), hint)
        for name in new[: self.width - len(self.places)]:
            self.places[name] = len(self.places)
        for name, value in x.items():
            if (place := self.places.get(name)) is not None:
                self.count[place] += 1
                self.mean[place] += (float(value) - self.mean[place]) / self.count[place]


class _RiverLearner:
    """What both regressors share: the learner is made, or copied, when the first sample is learned."""

    learner: LearnerLike

    def _start(self) -> None:
        self._columns: _Columns | None = None
        self._regressor: OnlineRegressor | None = None

    def _learn(self, x: Mapping[Hashable, Any], y: Array) -> None:
        if self._regressor is None or self._columns is None:
            given = isinstance(self.learner, ResidualLearner)
            width = self.learner.in_features if isinstance(self.learner, ResidualLearner) else max(len(x), 1)
            regressor = OnlineRegressor(make_learner(self.learner, width, len(y)))
            self._columns, self._regressor = _Columns(width, given), regressor
        self._columns.take(x)
        self._regressor.learn(self._columns.row(x), y)

    def _ask(self, x: Mapping[Hashable, Any]) -> Array | None:
        if self._regressor is None or self._columns is None:
            return None
        return self._regressor.predict(self._columns.row(x)[None])[0][0]

    def _interval(self, x: Mapping[Hashable, Any], level: float) -> tuple[Array, Array] | None:
        if self._regressor is None or self._columns is None:
            return None
        low, high = self._regressor.interval(self._columns.row(x)[None], level)
        return low[0], high[0]

    @classmethod
    def _unit_test_params(cls) -> Iterator[dict[str, Any]]:
        yield {"learner": None}


class RiverRegressor(_RiverLearner, base.Regressor):
    """``y = c + g(x)``, c the first target, g a learner: a regressor of river.

    Features get columns of x in the order in which they come (those of one sample by name); one that is
    missing is put at its mean so far. Before the first sample the prediction is None, which river does not
    score.

    Args:
        learner: untrained, of one output, whose ``in_features`` is the number of features; the stream may
            not have more. Or ``factory(in_features, out_features)``, None for the default: it is then made
            for the features of the first sample, and later ones are left out.
    """

    def __init__(self, learner: LearnerLike = None) -> None:
        self.learner = learner
        self._start()

    def learn_one(self, x: dict, y: float) -> None:
        """Learn one sample: features x by name, and y."""
        self._learn(x, np.array([float(y)]))

    def predict_one(self, x: dict) -> float | None:
        """Mean of y at these features; None before the first sample."""
        mean = self._ask(x)
        return None if mean is None else float(mean[0])

    def predict_interval_one(self, x: dict, level: float = 0.95) -> tuple[float, float] | None:
        """(low, high) that is to hold ``level`` of the samples; None before the first one."""
        ends = self._interval(x, level)
        return None if ends is None else (float(ends[0][0]), float(ends[1][0]))


class RiverMultiTargetRegressor(_RiverLearner, base.MultiTargetRegressor):
    """The same with several targets by name, those of the first sample; before it the prediction is empty.

    Args:
        learner: see :class:`RiverRegressor`; of as many outputs as there are targets.
    """

    def __init__(self, learner: LearnerLike = None) -> None:
        self.learner = learner
        self._targets: list[Hashable] = []
        self._start()

    def learn_one(self, x: dict, y: dict) -> None:
        """Learn one sample: features x by name, and y."""
        targets = self._targets or sorted(y, key=str)
        self._learn(x, np.array([float(y[name]) for name in targets]))
        self._targets = targets

    def predict_one(self, x: dict) -> dict:
        """Mean of each target by its name; empty before the first sample."""
        mean = self._ask(x)
        return {} if mean is None else dict(zip(self._targets, mean.tolist(), strict=True))

    def predict_interval_one(self, x: dict, level: float = 0.95) -> dict:
        """(low, high) of each target, which is to hold ``level`` of the samples."""
        ends = self._interval(x, level)
        if ends is None:
            return {}
        return dict(zip(self._targets, zip(ends[0].tolist(), ends[1].tolist(), strict=True), strict=True))
