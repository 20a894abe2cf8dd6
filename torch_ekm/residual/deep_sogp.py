"""The sparse online GP with learned features."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

from .deep_kernel import DeepKernel
from .kernels import SquaredExponential
from .sogp import SparseOnlineGP

_FROM_THE_PAST: dict[str, Any] = {"adapt_steps": 2, "adapt_memory": 2000}


@final
class DeepKernelSOGP(SparseOnlineGP):
    """A SparseOnlineGP on ``[x / L, net(x)]``, network and kernel learned online in constant memory.

    The basis is kept as inputs and embedded anew whenever the network moves; the natural form does not
    contain the kernel, so nothing else has to follow. See DeepKernel and PrequentialAdaptation.

    Thousands of weights want more than the last 32 samples, which on a trajectory are one place: 2000
    samples of the past are kept to learn them from, and each rebuild takes two steps.

    Args:
        hidden, features, seed: of the network.
        options: see SparseOnlineGP (without ``kernel``; by default ``adapt=True``, ``adapt_steps=2``,
            ``adapt_memory=2000``; with ``diffusion``, to which the past is another g, one and 0).
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        hidden: Sequence[int] = (64, 64),
        features: int = 16,
        seed: int = 0,
        **options: Any,
    ) -> None:
        fleet = {name: options[name] for name in ("batch_shape", "device") if name in options}
        base = SquaredExponential(in_features, **fleet)
        kernel = DeepKernel(base, hidden=hidden, features=features, seed=seed)
        defaults = {"adapt": True, **({} if options.get("diffusion") else _FROM_THE_PAST)}
        super().__init__(in_features, out_features, kernel=kernel, **{**defaults, **options})
