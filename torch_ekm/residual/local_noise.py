"""Noise as a function of x: a factor on the deviation by which innovations are standardised."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from ..typing import Bool, Float, Tensor
from .kernels.kernel import fleet_options
from .kernels.stationary import Matern32
from .sparse_gp.hyperparameters import LearnHyperparameters
from .sparse_gp.sparse_online_gp import SparseOnlineGP

SHARES = 0.0, 0.5, 1.0  #: of f to choose from
MEMORY, FREEDOM = 0.995, 4.0  #: of the evidence for them, and of the t law by which it goes
FLOOR, MOST = 0.1, 20.0  #: added to |z|, whose logarithm has no end; and where a large one is cut
CENTRE = 0.363  #: mean of -log(|z| + FLOOR) of a normal z
REACH = 4.0  #: of f
_CAPACITY, _VARIANCE = 30, 0.3  # of f
_OFFSET = 2  # of its rebuilds, which come 4 later than the default's, as it begins 4 later


class LocalNoise(nn.Module):
    """``r(x) = exp(s f(x))``, f a sparse GP that learns online how large innovations are at x::

        log(|i| / exp(f(x)) + 0.1) + 0.363 + f(x) = f(x) + noise
        p_s ~ exp(sum_j memory^j log t_4(i_{t-j}; exp(s f(x_{t-j})))),   s = sum_s p_s s

    i is the innovation in typical ones. Logarithms of a Gaussian process as in Goldberg, Williams and Bishop,
    Regression with input-dependent noise, NeurIPS 1997. Where noise does not depend on x, s goes to 0.

    Args:
        in_features, out_features: widths of x and i.
        options: ``batch_shape``, ``dtype`` and ``device``.
    """

    def __init__(self, in_features: int, out_features: int, **options: Any) -> None:
        super().__init__()
        self.gp = SparseOnlineGP(
            in_features, out_features, capacity=_CAPACITY, refresh_offset=_OFFSET, noise_variance=1.0,
            kernel=Matern32(in_features, variance=_VARIANCE, **fleet_options(options)),
            parts=[LearnHyperparameters()], **options,
        )  # fmt: skip
        like = self.gp.posterior.basis
        self.shares = nn.Buffer(like.new_tensor(SHARES), persistent=False)
        self.evidence = nn.Buffer(like.new_zeros(*self.gp.batch_shape, out_features, len(SHARES)))

    def log_factor(self, x: Float[Tensor, "*any in"]) -> Float[Tensor, "*all out"]:
        """log r(x)."""
        return self.share() * self._f(x)

    def with_slope(self, x: Float[Tensor, "*any in"]) -> tuple[Tensor, Float[Tensor, "*all out in"]]:
        """log r(x) and its derivative."""
        f, slope = self.gp.linearize(x)
        slope = slope * (self.share() * (f.abs() < REACH)).unsqueeze(-1)
        return self.share() * f.clamp(-REACH, REACH), slope

    def observe(
        self, x: Float[Tensor, "*batch in"], i: Float[Tensor, "*batch out"], mask: Bool[Tensor, "*batch"]
    ) -> None:
        """Learn from an innovation per model where ``mask``, in typical ones of that place."""
        f = self._f(x)
        size = i.abs().clamp_min(torch.finfo(i.dtype).tiny).log() + self.share() * f
        log_scale = self.shares * f.unsqueeze(-1)
        z2 = (2.0 * (size.unsqueeze(-1) - log_scale)).exp()
        evidence = MEMORY * self.evidence - log_scale - 0.5 * (FREEDOM + 1.0) * torch.log1p(z2 / FREEDOM)
        evidence = evidence - evidence.amax(-1, keepdim=True)
        self.evidence.copy_(torch.where(mask[..., None, None], evidence, self.evidence))
        target = ((size - f).exp().clamp_max(MOST) + FLOOR).log() + CENTRE + f
        self.gp.step(x, target, mask)

    def share(self) -> Float[Tensor, "*batch out"]:
        """s."""
        return self.evidence.softmax(-1) @ self.shares

    def _f(self, x: Tensor) -> Float[Tensor, "*all out"]:
        return self.gp(x).clamp(-REACH, REACH)

    def reset(self) -> None:
        """Forget all samples: r = 1."""
        self.gp.reset()
        self.evidence.zero_()
