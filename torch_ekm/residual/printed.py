"""The state of a learner, on one screen."""

from __future__ import annotations

from typing import Any

from torch import nn

from ..typing import Tensor

_FEW = 6  # numbers that are printed one by one


def numbers(values: Tensor) -> str:
    """``1.2, 3.4``; one of equal ones, of many the smallest and the largest."""
    flat = [f"{value:.3g}" for value in values.detach().flatten().tolist()]
    if len(set(flat)) == 1:
        return flat[0]
    return ", ".join(flat) if len(flat) <= _FEW else f"{min(flat, key=float)} to {max(flat, key=float)}"


def kernel_in_words(kernel: nn.Module) -> str:
    """``Matern32: lengthscale 2, variance 1``; of a deep kernel its network, too."""
    base: Any = getattr(kernel, "base", kernel)
    network = ""
    if base is not kernel:
        weights: Any = kernel.weights
        widths = [weights[0].shape[-2], *(weight.shape[-1] for weight in weights)]
        network = " and a network " + "-".join(map(str, widths))
    values = ((name.split(".")[-1], p) for name, p in base.hyperparameters().items())
    figures = ", ".join(f"{n.removeprefix('log_').replace('_', ' ')} {numbers(p.exp())}" for n, p in values)
    return f"{type(base).__name__}{network}: {figures}"


def sparse_gp(gp: Any) -> list[str]:
    """Basis, kernel, noise, units and parts of a SparseOnlineGP."""
    count, units = gp.posterior.count, gp.units
    lines = [
        f"{numbers(count)} of {gp.capacity} basis vectors after {gp.n_samples} samples",
        f"kernel {kernel_in_words(gp.kernel)}",
        f"noise of y: {numbers(gp.noise_variance.sqrt())}",
    ]
    shift, scale, scale_y = map(numbers, (units.input.shift, units.input.scale, units.output.scale))
    lines.append(f"units: (x - [{shift}]) / [{scale}], y / [{scale_y}]")
    parts = (f"{type(part).__name__}({part.extra_repr()})" for part in gp.parts)
    return [*lines, f"parts: {', '.join(parts)}"]


def mixture(g: Any) -> list[str]:
    """Weights, basis, kernel and noise of a mixture's learners, and units of the first."""
    lines = [f"{numbers(g.count)} samples; weight of each learner by output:"]
    units: list[str] = []
    for i, learner in enumerate(g.members):
        own = sparse_gp(learner) if hasattr(learner, "posterior") else [learner.extra_repr()]
        units = units or [line for line in own if line.startswith("units")]
        short = "; ".join(own[:3]).replace("basis vectors after", "points,").replace("kernel ", "")
        lines.append(f"  [{numbers(g.weights[..., i])}] {type(learner).__name__}, {short}")
    return [*lines, f"share of what they say, the rest is the model alone: {numbers(g.gain.sum(-1))}", *units]
