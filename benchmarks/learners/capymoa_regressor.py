"""Learners as regressors of CapyMOA, whose interface is kept without importing it (it needs Java)."""

from __future__ import annotations

from typing import Any

import numpy as np

from torch_ekm.interop.online_regressor import LearnerLike, OnlineRegressor, make_learner


class CapyMOARegressor:
    """``y = c + g(x)``, c the first target, g a learner: what CapyMOA's evaluations ask of a regressor.

    Before the first sample the prediction is 0, as that of MOA's own learners.

    Args:
        schema: of the stream (``stream.get_schema()``).
        learner: ``factory(in_features, out_features)``, an untrained learner of one output, which is copied,
            or None for the default.
        random_seed: kept for CapyMOA; a learner has its own.
    """

    def __init__(self, schema: Any = None, learner: LearnerLike = None, random_seed: int = 1) -> None:
        self.schema, self.learner, self.random_seed = schema, learner, random_seed
        self._regressor: OnlineRegressor | None = None

    def __str__(self) -> str:
        made = self.learner if self._regressor is None else self._regressor.learner
        return f"torch_ekm {getattr(made, '__name__', type(made).__name__)}"

    def train(self, instance: Any) -> None:
        """Learn one sample: ``instance.x`` ``(in,)`` and ``instance.y_value``."""
        x = np.asarray(instance.x, dtype=np.float64)
        if self._regressor is None:
            self._regressor = OnlineRegressor(make_learner(self.learner, len(x), 1))
        self._regressor.learn(x, np.array([instance.y_value], dtype=np.float64))

    def predict(self, instance: Any) -> float:
        """Mean of y at ``instance.x``; 0 before the first sample."""
        if self._regressor is None:
            return 0.0
        return float(self._regressor.predict(np.asarray(instance.x, dtype=np.float64)[None])[0][0, 0])

    def predict_interval(self, instance: Any, level: float = 0.95) -> tuple[float, float, float]:
        """(low, mean, high), as CapyMOA's interval learners; the ends are to hold ``level`` of samples."""
        if self._regressor is None:
            return 0.0, 0.0, 0.0
        low, high = self._regressor.interval(np.asarray(instance.x, dtype=np.float64)[None], level)
        return float(low[0, 0]), float(low[0, 0] + high[0, 0]) / 2, float(high[0, 0])
