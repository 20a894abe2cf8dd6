"""What judges the experts of a mixture: its buffers as the compiled loops see them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.distributions import StudentT

from ..typing import Array, Tensor
from .base import FARTHEST
from .sparse_gp.engine.compiled import is_plain_one, sources_of
from .sparse_gp.engine.loading import load_loops


def warm_up() -> bool:
    """Load the compiled loops now, not at the first update; returns whether there are any (extra ``fast``).

    A fresh installation compiles them first, for some ten seconds. Without this call another process does so
    meanwhile, and torch does the work.
    """
    if load_loops(wait=True) is None:
        return False
    from . import numba_mixture  # noqa: F401  loaded by its import

    return True


class CompiledJudge:
    """A mixture's buffers as arrays that share their memory, made again whenever a buffer is another one.

    It judges on the CPU in float64, where numba is installed.
    """

    def __init__(self) -> None:
        self._sources: list[tuple[dict, str, Tensor, int]] = []
        self._usable = False

    def __deepcopy__(self, memo: dict) -> CompiledJudge:
        return CompiledJudge()

    def __reduce__(self) -> tuple:
        return CompiledJudge, ()

    def judge(self, g: Any, y: Tensor, mask: Tensor | None, moments: list) -> Tensor | None:
        """Take one sample per model in, given what the mixture's learners predicted; returns the nis.

        None: torch must do it.
        """
        if not self._takes(g):
            return None
        means, variances, far, ratio, figures = self._work
        rows = len(far)
        for i, (mean, variance) in enumerate(moments):
            means[:, i] = mean.numpy().reshape(rows)
            variances[:, i] = variance.numpy().reshape(rows)
        self._make_finite(means, variances)
        on = np.ones(self._n, np.bool_) if mask is None else mask.numpy().reshape(self._n).copy()
        nis, loops, a = np.empty(self._n), self._loops, self._arrays
        with np.errstate(all="ignore"):
            loops.measure_fleet(
                y.contiguous().numpy().reshape(rows), means, variances, self._experts, a["innovation"],
                a["level"], a["gain"], a["mass"], self._offset, self._inflation, FARTHEST * self._largest,
                *self._tails, far, ratio, figures,
            )  # fmt: skip
            np.log1p(ratio, out=ratio)
            loops.fold_fleet(
                on, far, ratio, figures, self._experts, self._prior, a["evidence"], a["innovation"],
                a["level"], a["trend"], self._inflation, self._count, *self._laws, *self._tails, nis,
            )  # fmt: skip
            np.exp(ratio, out=ratio)
        loops.settle_fleet(
            on, ratio, self._experts, a["innovation"], a["level"], a["mass"], a["shift"], a["spread"],
            a["gain"], self._offset,
        )  # fmt: skip
        return torch.from_numpy(nis.reshape(tuple(g.batch_shape)))

    def combine(self, g: Any, x: Tensor, each: list) -> Tensor | None:
        """Mean and deviations of g and y, ``(3, *batch, out)``, given what the learners predict for one query
        per model, see ``both_moments``.

        None: torch must do it.
        """
        if torch.compiler.is_compiling() or not is_plain_one(x, (*g.batch_shape, g.in_features)):
            return None
        if any(t.requires_grad for one in each for t in one) or not self._takes(g):
            return None
        a, out = self._arrays, np.empty((3, self._offset.size))
        rows = [np.array([t.numpy().reshape(-1) for t in part]) for part in zip(*each, strict=True)]
        parts = [np.array(part.T, dtype=np.float64, order="C") for part in rows]
        self._make_finite(*parts)
        self._loops.combine_fleet(
            *parts, self._experts, a["gain"], a["mass"], a["shift"], a["spread"], self._offset,
            self._inflation, FARTHEST * self._largest, out,
        )  # fmt: skip
        return torch.from_numpy(out.reshape(3, *g.offset.shape))

    def _make_finite(self, means: Array, *variances: Array) -> None:
        """See ``_finite`` and ``_wide`` of the mixture."""
        if not np.isfinite(means.sum() + sum(v.sum() for v in variances)):
            np.nan_to_num(means, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
            for v in variances:
                np.copyto(v, np.square(self._largest)[:, None], where=~np.isfinite(v))

    def _takes(self, g: Any) -> bool:
        """Whether compiled loops can do it; prepares the arrays."""
        if load_loops() is None:
            return False
        if any(owner.get(name) is not t or t.data_ptr() != at for owner, name, t, at in self._sources):
            self._sources = []
        if not self._sources:
            self._bind(g)
        return self._usable

    def _bind(self, g: Any) -> None:
        self._sources = sources_of(g, tuple(g.buffers(recurse=False)) + tuple(g.tails.buffers()))
        on_host = g.dtype == torch.float64 and g.device.type == "cpu"
        self._usable = on_host and all(t.is_contiguous() for _, _, t, _ in self._sources)
        if not self._usable:
            return
        from . import numba_mixture

        self._loops, self._n = numba_mixture, g.batch_shape.numel()
        rows, (n_experts, n_learners) = self._n * g.out_features, g.owner.shape
        names = "evidence", "innovation", "level", "trend", "gain", "mass", "shift", "spread"
        self._arrays: dict[str, Array] = {k: g.get_buffer(k).numpy().reshape(rows, -1) for k in names}
        self._offset, self._inflation = g.offset.numpy().reshape(-1), g.inflation.numpy().reshape(-1)
        self._largest = g.largest.numpy().reshape(-1)
        self._count, self._prior = g.count.numpy().reshape(-1), g.prior.double().numpy()
        self._experts, tails = g.get_buffer("_experts").numpy(), g.tails
        at_zero = StudentT(tails.freedoms).log_prob(torch.zeros_like(tails.freedoms))
        self._laws = tuple(t.numpy() for t in (tails.rates, tails.freedoms, at_zero))
        self._tails = tuple(t.numpy().reshape(rows, -1) for t in (tails.log_scale, tails.evidence))
        learners, experts = np.empty((2, rows, n_learners)), np.empty((2, rows, n_experts))
        self._work = *learners, *experts, np.empty((rows, 2))
