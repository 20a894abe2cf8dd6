"""The learner that is taken where nobody names one."""

from __future__ import annotations

from ..residual import (
    DeepKernelSOGP,
    LearnHyperparameters,
    MixtureResidual,
    ProcessNoise,
    ResidualLearner,
    RobustWeight,
    SparseOnlineGP,
    Standardize,
)


def default_learner(in_features: int, out_features: int) -> ResidualLearner:
    """A mixture of one that learns features and one that wanders, see docs/choosing_a_learner.md."""
    still = [RobustWeight(3.0), Standardize()]
    wandering = [RobustWeight(3.0), ProcessNoise(0.003), Standardize(), LearnHyperparameters()]
    return MixtureResidual(
        [
            DeepKernelSOGP(in_features, out_features, parts=still),
            SparseOnlineGP(in_features, out_features, parts=wandering),
        ]
    )
