from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch

from ..._checks import check_count, check_counts
from ...exceptions import ParameterError
from ...typing import Float, Tensor
from .kernel import BufferList, Kernel
from .stationary import StationaryKernel, squared_distances

_INITIAL_SCALE = 0.3  # of the features at the start, relative to an ordinary initialisation


class DeepKernel(Kernel):
    """``k(x, z) = v phi(|x - z|^2_L + |net(x) - net(z)|^2)``.

    The features stand next to the inputs, not in their place: with a constant network the
    kernel is the plain one, and with any network it stays positive definite on distinct inputs,
    so features cannot collapse the basis. The network is a multilayer perceptron with tanh;
    its last layer starts small, so the learner starts as the plain GP (Wilson et al., Deep kernel
    learning, AISTATS 2016, learned here by the lagged prequential loss).

    Args:
        base: stationary kernel that gives v, L and phi.
        hidden: widths of the hidden layers.
        features: width of net(x).
        seed: of the weights.

    Raises:
        ParameterError: ``base`` is not stationary.
    """

    starts = ("seed",)

    def __init__(
        self, base: StationaryKernel, *, hidden: Sequence[int] = (64, 64), features: int = 16, seed: int = 0
    ) -> None:
        super().__init__()
        if not isinstance(base, StationaryKernel):
            raise ParameterError("base", type(base).__name__, "a stationary kernel")
        self.base = base
        like = base.log_lengthscale
        fleet, generator = like.shape[:-1], torch.Generator().manual_seed(seed)
        widths = [like.shape[-1], *check_counts("hidden", hidden), check_count("features", features)]
        self.weights, self.biases = BufferList(), BufferList()
        for layer, (n_in, n_out) in enumerate(itertools.pairwise(widths)):
            scale = (_INITIAL_SCALE if layer == len(widths) - 2 else 1.0) / n_in**0.5
            # every model of a fleet starts with the same weights, as a single model would
            weight = scale * torch.randn(n_in, n_out, generator=generator, dtype=torch.float64)
            weight = weight.to(like).expand(*fleet, n_in, n_out).contiguous()
            self.weights.append(weight)
            if layer < len(widths) - 2:  # a constant in the features has no effect
                self.biases.append(like.new_zeros(*fleet, n_out))

    def net(self, x: Float[Tensor, "*any n d"]) -> Float[Tensor, "*batch n features"]:
        """The features of x that the network has learned, near 0 at the start."""
        *hidden, last = self.weights  # a slice would be a new module
        for weight, bias in zip(hidden, self.biases, strict=True):
            x = torch.tanh(x @ weight + bias.unsqueeze(-2))
        return x @ last

    def net_jacobian(self, x: Float[Tensor, "*batch d"]) -> tuple[Tensor, Tensor]:
        """``(net(x), (d net/dx)')``: shapes ``(*batch, features)`` and ``(*batch, d, features)``."""
        x, slope = x.unsqueeze(-2), None
        *hidden, last = self.weights
        for weight, bias in zip(hidden, self.biases, strict=True):
            x = torch.tanh(x @ weight + bias.unsqueeze(-2))
            step = weight if slope is None else slope @ weight
            slope = step * (1.0 - x * x)
        return (x @ last).squeeze(-2), last if slope is None else slope @ last

    def embed(self, x: Float[Tensor, "*any n d"]) -> Float[Tensor, "*batch n d_plus_features"]:
        """``[x / L, net(x)]``: the kernel is a unit one on these."""
        w = self.base.log_lengthscale.neg().exp().unsqueeze(-2)
        return torch.cat([x * w, self.net(x)], dim=-1)

    def forward(self, x: Tensor, z: Tensor) -> Tensor:
        a = self.embed(x)
        d2 = squared_distances(a, a if z is x else self.embed(z))
        return self.base.log_variance.exp()[..., None, None] * self.base.phi_psi(d2)[0]

    def diagonal(self, x: Tensor) -> Tensor:
        return self.base.diagonal(x)

    def with_gradient(self, x: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        w = self.base.log_lengthscale.neg().exp().unsqueeze(-2)
        value, slope = self.net_jacobian(x)
        near = (z - x.unsqueeze(-2)) * w
        far = self.net(z) - value.unsqueeze(-2)
        phi, psi = self.base.phi_psi(near.square().sum(-1) + far.square().sum(-1))
        v = self.base.log_variance.exp().unsqueeze(-1)
        return v * phi, (v * psi).unsqueeze(-1) * (near * w + far @ slope.mT)

    def shift_invariant(self, in_features: int) -> list[bool]:
        # not invariant, but the network learns any shift: centred inputs keep tanh in its range
        return [True] * in_features
