"""The learner for somebody who tells nothing but the sizes."""

from __future__ import annotations

from typing import Any, Literal

from .last_residual import LastResidual
from .mixture import MixtureResidual
from .sparse_gp.deep import DeepKernelSOGP
from .sparse_gp.forgetting import ForgettingFactor, ProcessNoise
from .sparse_gp.hyperparameters import LearnHyperparameters
from .sparse_gp.monitor import DetectChanges, RobustWeight
from .sparse_gp.sparse_online_gp import SparseOnlineGP


def default_learner(
    in_features: int,
    out_features: int,
    *,
    capacity: int = 100,
    output_offset: Literal["zero", "learned"] = "zero",
    **options: Any,
) -> MixtureResidual:
    """What we recommend to somebody who tells us nothing: a mixture of three, in constant memory.

    One learner keeps the past and learns features, one lets g wander, one forgets and is told the last
    residual; the model alone, and the last residual alone, are among the experts. Evidence decides, for each
    output. It predicts the *next* sample: see MixtureResidual.

    Args:
        capacity: basis points of each of the three.
        output_offset: ``"learned"`` if y is no residual but has a mean of its own.
        options: see ResidualLearner.

    Raises:
        ParameterError: a figure is outside its range.
    """
    common: dict[str, Any] = {"capacity": capacity, "output_offset": output_offset, **options}
    wanders = [RobustWeight(3.0), ProcessNoise(0.003), LearnHyperparameters()]
    forgets = [RobustWeight(3.0), DetectChanges(), ForgettingFactor(0.99), LearnHyperparameters()]
    d, m = in_features, out_features
    members = [
        DeepKernelSOGP(d, m, **common),
        SparseOnlineGP(d, m, parts=wanders, **common),
        LastResidual(SparseOnlineGP(d + m, m, parts=forgets, **common)),
    ]
    return MixtureResidual(members, levels=(0.0, 0.03, 0.1, 1.0), trends=(0.0, 0.5), **options)
