from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from torch import nn

from ..kernels.deep import DeepKernel
from ..kernels.kernel import fleet_options
from ..kernels.stationary import Matern32, StationaryKernel
from .forgetting import ProcessNoise
from .hyperparameters import LearnHyperparameters
from .monitor import CalibrateNoise, DetectChanges, RobustWeight
from .part import copy_parts
from .sparse_online_gp import SparseOnlineGP


def DeepKernelSOGP(  # noqa: N802  a kind of learner, called like the others
    in_features: int,
    out_features: int,
    *,
    hidden: Sequence[int] | None = None,
    features: int | None = None,
    seed: int = 0,
    base: StationaryKernel | None = None,
    parts: Iterable[nn.Module] | None = None,
    **options: Any,
) -> SparseOnlineGP:
    """A SparseOnlineGP on ``[x / L, net(x)]``, network and kernel learned online in constant memory.

    The basis is kept as inputs and embedded again whenever the network moves; the natural form does not
    contain the kernel, so nothing else has to follow. See DeepKernel and LearnHyperparameters.

    Thousands of weights want more than the last 32 samples, which on a trajectory are one place: 2000
    samples of the past are kept to learn them from, and each rebuild takes two steps. Where g wanders
    (``ProcessNoise``) the past is another g: one step, and no memory.

    Args:
        hidden, features: of the network; (64, 64) and 16, or (32, 32) and 6 without a memory.
        seed: of its weights.
        base: kernel on inputs and features, Matern 3/2 by default.
        parts: as of SparseOnlineGP, by default ``[RobustWeight(3.0), DetectChanges(), CalibrateNoise()]``;
            ``LearnHyperparameters`` is added if it is not among them.
        options: see SparseOnlineGP (without ``kernel``).

    Raises:
        ParameterError: from SparseOnlineGP and DeepKernel.
    """
    calibrated = [RobustWeight(3.0), DetectChanges(), CalibrateNoise()]
    own = calibrated if parts is None else copy_parts(parts)
    learning = next((part for part in own if isinstance(part, LearnHyperparameters)), None)
    if learning is None:
        wanders = any(isinstance(part, ProcessNoise) for part in own)
        learning = LearnHyperparameters() if wanders else LearnHyperparameters(steps=2, memory=2000)
        own.append(learning)
    fleet = fleet_options(options)
    kernel = DeepKernel(
        Matern32(in_features, **fleet) if base is None else base,
        hidden=hidden if hidden is not None else (64, 64) if learning.memory else (32, 32),
        features=features if features is not None else 16 if learning.memory else 6,
        seed=seed,
    )
    return SparseOnlineGP(in_features, out_features, kernel=kernel, parts=own, **options)
