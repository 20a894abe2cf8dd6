"""The learner that is taken where nobody names one."""

from __future__ import annotations

from ..residual import ResidualLearner
from ..residual import default_learner as recommended


def default_learner(in_features: int, out_features: int) -> ResidualLearner:
    """The package's default, for targets that are nobody's residual."""
    return recommended(in_features, out_features, output_offset="learned")
