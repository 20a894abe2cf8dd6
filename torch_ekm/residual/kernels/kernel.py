"""Covariance functions with closed-form gradients, on ``(*batch, n, d)`` tensors.

A kernel gives four things: the matrix ``k(X, Z)``, its diagonal ``k(x, x)``, and the derivatives
of both with respect to a query x. Hyperparameters are logarithms with the shape of the fleet in
front, ``(*batch_shape, ...)``; they are buffers, since only the learner's own adaptation moves them (an
optimiser would leave its caches stale).
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import torch
from torch import nn

from ..._checks import check_counts, check_kind
from ..._recorded import Recorded
from ...exceptions import ParameterError
from ...typing import Float, Tensor


class Kernel(Recorded, nn.Module, ABC):
    """A covariance function k(x, z) of two points, with its derivative by the first.

    A kernel of your own implements ``forward``, ``diagonal`` and ``with_gradient``, and ``diagonal_gradient``
    unless k(x, x) is constant. Its hyperparameters are its buffers; one whose name begins with ``log_`` keeps
    within exp(-7) and exp(7). Those of a fleet have its axes in front.
    """

    def hyperparameters(self) -> dict[str, Tensor]:
        """What is learned of it, by name: its floating-point buffers, and parameters where it has any."""
        found = [*self.named_parameters(), *self.named_buffers()]
        return {name: t for name, t in found if t.is_floating_point()}

    @abstractmethod
    def forward(self, x: Float[Tensor, "*batch n d"], z: Float[Tensor, "*batch m d"]) -> Tensor:
        """Matrix k(x_i, z_j) of two sets of points, ``(*batch, n, m)``."""

    @abstractmethod
    def diagonal(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch"]:
        """k(x, x) of one point per model; further axes go in front."""

    @abstractmethod
    def with_gradient(
        self, x: Float[Tensor, "*batch d"], z: Float[Tensor, "*batch m d"]
    ) -> tuple[Tensor, Tensor]:
        """``(k(x, z_j), d k(x, z_j)/dx)``: shapes ``(*batch, m)`` and ``(*batch, m, d)``."""

    def diagonal_gradient(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """d k(x, x)/dx of one point per model; 0 here, where the same prior variance holds everywhere."""
        return torch.zeros_like(x)

    def vector(self, x: Float[Tensor, "*any d"], z: Float[Tensor, "*batch m d"]) -> Tensor:
        """k(x, z_j) for one query per model, ``(*batch, m)``; further axes go in front."""
        return self(x.unsqueeze(-2), z).squeeze(-2)

    def diagonal_of_set(self, x: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n"]:
        """k(x_i, x_i) of n points per model."""
        return self.diagonal(x.movedim(-2, 0)).movedim(0, -1)

    def shift_invariant(self, in_features: int) -> list[bool]:
        """Columns of x whose origin does not matter; a normaliser may centre these and no others."""
        return [False] * in_features

    def derivative_variance(self, x: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch d"]:
        """Prior variance of dg/dx_j, ``d2k(x, z)/dx_j dz_j`` at ``z = x``."""
        with torch.inference_mode(False), torch.enable_grad():
            z, kept = x.detach().clone().requires_grad_(True), copy.deepcopy(self)  # who learns may move it
            slopes = kept.with_gradient(x.detach().clone(), z.unsqueeze(-2))[1].squeeze(-2)
            by = [torch.autograd.grad(one.sum(), z, retain_graph=True)[0] for one in slopes.unbind(-1)]
        return torch.stack([one[..., j] for j, one in enumerate(by)], dim=-1)

    def grows(self, in_features: int) -> list[bool]:
        """Columns of x along which functions drawn from the prior grow without end."""
        return [False] * in_features


class BufferList(nn.Module):
    """Buffers one after the other, named by their places."""

    def append(self, values: Tensor) -> None:
        """One more at the end."""
        self.register_buffer(str(len(self)), values)

    def __iter__(self) -> Iterator[Tensor]:
        return iter(cast("dict[str, Tensor]", self._buffers).values())

    def __len__(self) -> int:
        return len(self._buffers)

    def __getitem__(self, place: int) -> Tensor:
        return list(self)[place]


def log_parameter(
    name: str, value: float | Sequence[float] | Tensor, shape: tuple[int, ...], **factory
) -> nn.Buffer:
    """``log(value)``, broadcast to ``shape``.

    Raises:
        ParameterError: a value is not positive and finite, or does not broadcast.
    """
    try:
        values = torch.as_tensor(value, **factory)
    except (TypeError, ValueError, RuntimeError):
        raise ParameterError(name, value, "one number or numbers") from None
    if not bool(((values > 0) & values.isfinite()).all()):
        raise ParameterError(name, values.tolist(), "positive and finite")
    try:
        values = values.expand(shape)
    except RuntimeError:
        raise ParameterError(name, values.tolist(), f"one number or of shape {tuple(shape)}") from None
    return nn.Buffer(values.log().contiguous())


def check_kernel(kernel: Kernel, in_features: int, batch_shape: tuple[int, ...]) -> Kernel:
    """A copy of the kernel, if it takes inputs of that width; each model of a fleet has one of its own.

    Raises:
        ParameterError: it is none, or of another width or fleet, or of several.
    """
    valid = f"a Kernel of {in_features} inputs"
    if batch_shape:
        valid += f", for one model or, with all its hyperparameters, for a fleet of {tuple(batch_shape)}"
    check_kind("kernel", kernel, Kernel, valid)
    kernel = copy.deepcopy(kernel)
    theta, fleet = list(kernel.hyperparameters().values()), tuple(batch_shape)
    try:
        shape = _shape_of(kernel, in_features)
        if fleet and shape == ():
            for one in theta:
                one.data = one.expand(*fleet, *one.shape).contiguous()
            shape = _shape_of(kernel, in_features) if theta else fleet
    except RuntimeError:
        raise ParameterError("kernel", repr(kernel), valid) from None
    if shape != fleet or any(one.shape[: len(fleet)] != fleet for one in theta):
        raise ParameterError("kernel", repr(kernel), valid)
    return kernel


def fleet_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Those of a learner's options that its kernel shares: fleet and device.

    Raises:
        ParameterError: the fleet's shape is none.
    """
    check_counts("batch_shape", options.get("batch_shape", ()))
    return {name: options[name] for name in ("batch_shape", "device") if name in options}


def _shape_of(kernel: Kernel, in_features: int) -> tuple[int, ...]:
    like = next(iter(kernel.hyperparameters().values()), torch.empty(0, dtype=torch.float64))
    x = like.new_zeros(2, in_features)
    return tuple(kernel(x, x).shape[:-2])
