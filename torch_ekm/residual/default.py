from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

from ..exceptions import UnknownNameError
from .kernels.kernel import fleet_options
from .kernels.linear import LinearKernel
from .kernels.stationary import Matern32
from .mixture import MixtureResidual
from .sparse_gp.forgetting import ForgettingFactor, ProcessNoise
from .sparse_gp.hyperparameters import LearnHyperparameters
from .sparse_gp.monitor import DetectChanges, RobustWeight
from .sparse_gp.sparse_online_gp import DeepKernelSOGP, SparseOnlineGP
from .sparse_gp.units import Standardize

_OPTIONS = ("dtype", "device", "batch_shape", "on_invalid")


def default_learner(
    in_features: int,
    out_features: int,
    *,
    capacity: int = 100,
    output_offset: Literal["zero", "learned"] = "zero",
    input_resolution: float | Sequence[float] = 0.0,
    output_scale: float | Sequence[float] = 0.0,
    **options: Any,
) -> MixtureResidual:
    """The recommended learner where nothing is known of the data: a mixture of four, in constant memory.

    Two learners keep the past and learn features, of which one distrusts large samples and one does not (rare
    ones may be outliers, or what is worth learning); one lets g wander; one is linear in x and forgets.
    The model alone, and the last residual alone, are among the experts. Evidence decides, for each output.
    Noise may depend on x, and a system that comes back is known. It predicts the *next* sample: see
    MixtureResidual.

    Args:
        capacity: basis vectors of each of the four.
        output_offset: ``"learned"`` if y is no residual but has a mean of its own.
        input_resolution, output_scale: sizes below which x and y mean nothing, if they are known, see
            Standardize.
        options: see ResidualLearner.

    Raises:
        ParameterError: a figure is outside its range.
        UnknownNameError: there is no such option; the message lists them.
    """
    unknown = [name for name in options if name not in _OPTIONS]
    if unknown:
        raise UnknownNameError("option", unknown[0], ("capacity", "output_offset", *_OPTIONS))
    d, m = in_features, out_features
    units = Standardize(output_offset, input_resolution, output_scale)
    every = 32  # samples between two rebuilds
    common: dict[str, Any] = {
        "capacity": capacity, "standardize": units, "refresh_every": every, **options
    }  # fmt: skip
    # no rebuild of many points falls on another one, or on a part of a deep kernel's steps
    late: list[dict[str, Any]] = [{**common, "refresh_offset": offset} for offset in (0, 8, 18, 30)]
    fleet = fleet_options(options)
    wanders = [RobustWeight(3.0), ProcessNoise(0.003), LearnHyperparameters()]
    fades = [RobustWeight(3.0), ForgettingFactor(0.998), LearnHyperparameters()]
    # it reaches twice as far as the others, since the smoothness of g is unknown; it refuses a width below 1
    long = Matern32(d, lengthscale=2.0 * math.sqrt(max(d, 1)), **fleet)
    members = [
        DeepKernelSOGP(d, m, base=long, parts=[RobustWeight(3.0), DetectChanges()], **late[0]),
        DeepKernelSOGP(d, m, parts=[DetectChanges()], **late[1]),
        SparseOnlineGP(d, m, parts=wanders, **late[2]),
    ]
    # of functions linear in x as many points say all
    few = {**late[3], "capacity": min(capacity, d + 1)}
    members.append(SparseOnlineGP(d, m, kernel=LinearKernel(d, **fleet), parts=fades, **few))
    # a line through two samples extrapolates to anything, so its weight rises later
    doubts = (0.0, 0.0, 0.0, 2.0)
    return MixtureResidual(members, levels=(0.0, 0.03, 0.1, 1.0), trends=(0.0, 0.5), doubts=doubts, **options)
