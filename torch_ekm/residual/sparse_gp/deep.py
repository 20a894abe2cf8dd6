"""The sparse online GP with learned features."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

from ..kernels.deep import DeepKernel
from ..kernels.kernel import SquaredExponential
from .sparse_online_gp import SparseOnlineGP

_FROM_THE_PAST: dict[str, Any] = {"adapt_steps": 2, "adapt_memory": 2000}


@final
class DeepKernelSOGP(SparseOnlineGP):
    """A SparseOnlineGP on ``[x / L, net(x)]``, network and kernel learned online in constant memory.

    The basis is kept as inputs and embedded anew whenever the network moves; the natural form does not
    contain the kernel, so nothing else has to follow. See DeepKernel and PrequentialAdaptation.

    Thousands of weights want more than the last 32 samples, which on a trajectory are one place: 2000
    samples of the past are kept to learn them from, and each rebuild takes two steps.

    Args:
        hidden, features: of the network; (64, 64) and 16, or (32, 32) and 6 without a memory.
        seed: of its weights.
        options: see SparseOnlineGP (without ``kernel``; by default ``adapt=True``, ``adapt_steps=2``,
            ``adapt_memory=2000``; with ``diffusion``, to which the past is another g, one and 0).
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        hidden: Sequence[int] | None = None,
        features: int | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        fleet = {name: options[name] for name in ("batch_shape", "device") if name in options}
        base = SquaredExponential(in_features, **fleet)
        options = {"adapt": True, **({} if options.get("diffusion") else _FROM_THE_PAST), **options}
        small = not options.get("adapt_memory")
        if hidden is None:
            hidden = (32, 32) if small else (64, 64)
        if features is None:
            features = 6 if small else 16
        kernel = DeepKernel(base, hidden=hidden, features=features, seed=seed)
        super().__init__(in_features, out_features, kernel=kernel, **options)
