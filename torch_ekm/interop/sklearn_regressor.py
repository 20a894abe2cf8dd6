"""Learners as regressors of scikit-learn with ``partial_fit`` (extra ``interop``)."""

from __future__ import annotations

from typing import Any, Self

import numpy as np

from .._extras import require
from ..typing import Array
from .online_regressor import LearnerLike, OnlineRegressor, make_learner

_base, _validation = require("sklearn.base", "interop"), require("sklearn.utils.validation", "interop")


class SklearnRegressor(_base.MultiOutputMixin, _base.RegressorMixin, _base.BaseEstimator):
    """``y = c + g(X)``, c the first target, g a learner: a regressor of scikit-learn.

    The rows of X ``(n, in)`` and y ``(n,)`` or ``(n, out)`` are learned one after the other, in their order:
    :meth:`partial_fit` goes on, :meth:`fit` begins again.

    Args:
        learner: ``factory(in_features, out_features)``, an untrained learner of the right sizes, which is
            copied, or None for the default.
    """

    def __init__(self, learner: LearnerLike = None) -> None:
        self.learner = learner

    def fit(self, X: Any, y: Any) -> Self:
        """Forget everything, and learn the rows in their order."""
        return self._learn(X, y, reset=True)

    def partial_fit(self, X: Any, y: Any) -> Self:
        """Learn further rows in their order, on top of what is known."""
        return self._learn(X, y, reset=not hasattr(self, "regressor_"))

    def predict(self, X: Any, return_std: bool = False) -> Array | tuple[Array, Array]:
        """Mean of y, ``(n,)`` or ``(n, out)``; with ``return_std`` also the standard deviation of y."""
        _validation.check_is_fitted(self)
        X = _validation.validate_data(self, X, reset=False, dtype=np.float64)
        mean, deviation = self.regressor_.predict(X)
        if self.flat_:
            mean, deviation = mean[:, 0], deviation[:, 0]
        return (mean, deviation) if return_std else mean

    def _learn(self, X: Any, y: Any, reset: bool) -> Self:
        kind = {"multi_output": True, "y_numeric": True, "dtype": np.float64}
        X, y = _validation.validate_data(self, X, y, reset=reset, **kind)
        rows = np.asarray(y, dtype=np.float64).reshape(len(X), -1)
        if reset:
            self.flat_ = np.ndim(y) == 1
            self.regressor_ = OnlineRegressor(make_learner(self.learner, X.shape[1], rows.shape[1]))
        for x, target in zip(X, rows, strict=True):
            self.regressor_.learn(x, target)
        return self
