"""Where a deep kernel is a plain one: what its network makes of queries and basis, for compiled loops."""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch

from ....typing import Array, Tensor
from ...kernels.deep import DeepKernel
from ..posterior import SparsePosterior


class Embedded(NamedTuple):
    """Inputs, one per model."""

    z: Array  #: in the learner's units, ``(models, d)``
    found: Array  #: embedded, the models' one after the other
    slope: Array  #: ``(d net/dz)'``, ``(models, d, features)``; empty where it was not wanted


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
        self._last: tuple[bytes, Embedded] | None = None

    def follow(self) -> None:
        """Embed the basis again if it or a parameter changed without :meth:`keep`; units may have changed."""
        self._last = None
        marks = [tensor._version for tensor in self._tensors]
        if marks != self._marks:
            with torch.no_grad():
                self.basis[:] = self._kernel.embed(self._posterior.basis).numpy().reshape(self.basis.shape)
            *hidden, last = self._kernel.weights
            layers = [p for pair in zip(hidden, self._kernel.biases, strict=True) for p in pair] + [last]
            rows = len(self._lengthscale)
            self._network = np.concatenate([p.detach().numpy().reshape(rows, -1) for p in layers], axis=1)
            self._marks = marks

    def of(self, x: Tensor, units: tuple[Array, ...], slopes: bool) -> Embedded:
        """One input per model, embedded. The last one is kept: it is asked for, then learned."""
        query, last = x.numpy().tobytes(), self._last
        if last is None or last[0] != query or (slopes and not last[1].slope.size):
            shift, scale = units
            last = query, self._embedded(x.numpy().reshape(len(self.basis), -1), shift, scale, slopes)
            self._last = last
        return last[1]

    def _embedded(self, x: Array, shift: Array, scale: Array, slopes: bool) -> Embedded:
        n, d = x.shape
        z, found = np.empty((n, d)), np.empty((n, self.width))
        slope = np.empty((n, d, self.width - d) if slopes else (0, 0, 0))
        self._loops.embed_fleet(
            self._widths, self._network, self._lengthscale, shift, scale, x.reshape(-1), slopes, z, found,
            slope,
        )  # fmt: skip
        return Embedded(z, found.reshape(-1), slope)

    def keep(self, z: Array, on: np.ndarray) -> None:
        """Write inputs into the free slots of the basis of the models ``on``."""
        models = np.flatnonzero(on)
        self._raw[models, self._slot[models]] = z[models]

    def by_x(self, by: Array, slope: Array, scale: Array) -> Array:
        """Derivatives by an input, ``(models, rows, d)``, from those by what was made of it."""
        by = by.reshape(len(self.basis), -1, self.width)
        d = self._raw.shape[-1]
        w = np.exp(-self._lengthscale)[:, None]
        return (by[..., :d] * w + by[..., d:] @ slope.swapaxes(-1, -2)) / scale[:, None]
