"""Where a deep kernel is a plain one: what its network makes of queries and basis, for compiled loops."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np
import torch

from ....typing import Array, Tensor
from ...kernels.deep import DeepKernel
from ..posterior import SparsePosterior


class Embedding:
    """``[z / L, net(z)]`` of queries and basis, on which a deep kernel is its base with unit lengthscales.

    The basis is embedded anew when it or the network changed; a sample that becomes a basis vector brings its
    own row.
    """

    def __init__(self, loops: ModuleType, kernel: DeepKernel, posterior: SparsePosterior) -> None:
        self._loops, self._kernel, self._posterior = loops, kernel, posterior
        self._tensors = (posterior.basis, kernel.base.log_lengthscale, *kernel.weights, *kernel.biases)
        self._marks: list[int] | None = None
        n, (M, d) = math.prod(posterior.batch_shape), posterior.basis.shape[-2:]
        widths = [d, *(weight.shape[-1] for weight in kernel.weights)]
        self._widths, self.width = np.array(widths), d + widths[-1]
        self._raw, self._slot = posterior.basis.numpy().reshape(n, M, d), posterior.slot.numpy().reshape(n)
        self.basis = np.empty((n, M, self.width))
        self._lengthscale = kernel.base.log_lengthscale.detach().numpy().reshape(-1, d)
        self._network = np.empty((len(self._lengthscale), 0))
        self._z, self._slope = np.empty((n, d)), np.empty((n, d, widths[-1]))
        self._scale = np.empty((1, d))

    def follow(self) -> None:
        """Embed the basis again if it or a parameter changed without :meth:`keep`."""
        marks = [tensor._version for tensor in self._tensors]
        if marks != self._marks:
            with torch.no_grad():
                self.basis[:] = self._kernel.embed(self._posterior.basis).numpy().reshape(self.basis.shape)
            *hidden, last = self._kernel.weights
            layers = [p for pair in zip(hidden, self._kernel.biases, strict=True) for p in pair] + [last]
            rows = len(self._lengthscale)
            self._network = np.concatenate([p.detach().numpy().reshape(rows, -1) for p in layers], axis=1)
            self._marks = marks

    def of(self, x: Tensor, units: tuple[Array, ...], slopes: bool) -> Array:
        """One input per model, embedded, the models' one after the other."""
        shift, self._scale = units
        found = np.empty((len(self.basis), self.width))
        self._loops.embed_fleet(
            self._widths, self._network, self._lengthscale, shift, self._scale, x.numpy().reshape(-1), slopes,
            self._z, found, self._slope,
        )  # fmt: skip
        return found.reshape(-1)

    def keep(self, on: np.ndarray) -> None:
        """Write the last inputs into the free slots of the basis of the models ``on``."""
        models = np.flatnonzero(on)
        self._raw[models, self._slot[models]] = self._z[models]

    def by_x(self, slope: Array, models: int) -> Array:
        """Slopes by the last input from those by what was made of it, ``(models, rows, d)``."""
        slope = slope.reshape(models, -1, self.width)
        d = self._raw.shape[-1]
        w = np.exp(-self._lengthscale)[:, None]
        by_z = slope[..., :d] * w + slope[..., d:] @ self._slope.swapaxes(-1, -2)
        return by_z / self._scale[:, None]
