"""The sparse online GP with learned features."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

from .deep_kernel import DeepKernel
from .kernels import SquaredExponential
from .sogp import SparseOnlineGP


@final
class DeepKernelSOGP(SparseOnlineGP):
    """A SparseOnlineGP on ``[x / L, net(x)]``, network and kernel learned online in constant memory.

    The basis is kept as inputs and embedded anew whenever the network moves; the natural form does not
    contain the kernel, so nothing else has to follow. See DeepKernel and PrequentialAdaptation.

    Args:
        hidden, features, seed: of the network.
        options: see SparseOnlineGP (without ``kernel``; ``adapt`` is on).
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        hidden: Sequence[int] = (32, 32),
        features: int = 6,
        seed: int = 0,
        **options: Any,
    ) -> None:
        fleet = {name: options[name] for name in ("batch_shape", "device") if name in options}
        base = SquaredExponential(in_features, **fleet)
        kernel = DeepKernel(base, hidden=hidden, features=features, seed=seed)
        super().__init__(in_features, out_features, kernel=kernel, **{"adapt": True, **options})
