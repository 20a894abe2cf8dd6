from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch

from ..._checks import check_sizes
from ...exceptions import ParameterError
from ...typing import Tensor
from ..running_scale import ALIEN, BLOCK, RunningScale, Units
from .part import Host, Part

_AHEAD = 1  # samples by which a block ends before a rebuild: it falls on the step there, on none of its own
_DOUBLING = 1024  # samples up to which units are adopted after 1, 2, 4, 8, ... samples, too


class Standardize(Part):
    """``z = (x - shift) / scale_x``, ``t = (y - offset) / scale_y``, from robust moments of the stream.

    Inputs are centred where the kernel is shift invariant; outputs are only scaled, so that 0 stays 0, unless
    their offset is to be learned. Outliers decide nothing; a column that has not varied keeps scale 1.

    New units are adopted when the caches are rebuilt, and after 1, 2, 4, 8, ... samples, since units are
    rough at first: the sample that comes counts in its own units. The basis follows exactly, and so does
    ``h <- (h + Omega 1 o) r`` for ``new t = (t + o) r``. Up to 32 samples all are learned again, so that one
    of the first that lies far out is judged by those that follow.

    Args:
        output_offset: ``"zero"``: g is 0 far from all samples, as a model's residual needs it;
            ``"learned"``: the mean of y.
        input_resolution: size of changes of x that mean something, one number or one per input; 0: not known.
            An input that only jitters below it hardly counts.
        output_scale: size of y that matters, one number or one per output; 0: not known.

    Raises:
        ParameterError: an unknown offset, or a size that is none.
    """

    def __init__(
        self,
        output_offset: Literal["zero", "learned"] = "zero",
        input_resolution: float | Sequence[float] = 0.0,
        output_scale: float | Sequence[float] = 0.0,
    ) -> None:
        super().__init__()
        if output_offset not in ("zero", "learned"):
            raise ParameterError("output_offset", output_offset, "'zero' or 'learned'")
        self.output_offset = output_offset
        self.input_resolution, self.output_scale = input_resolution, output_scale

    def bind(self, learner: Host) -> None:
        """The learner's units are those that were asked for."""
        d, m, like = learner.in_features, learner.out_features, learner.posterior.basis
        fleet = {"batch_shape": learner.batch_shape, "dtype": like.dtype, "device": like.device}
        learner.units = self.units(d, m, learner.kernel.shift_invariant(d), learner.kernel.grows(d), **fleet)

    def units(
        self, in_features: int, out_features: int, shifted: list[bool], grows: list[bool], **options: Any
    ) -> Units:
        """0 and 1 at first; of columns of x that are centred, and that are cut, see RunningScale."""
        centred = [self.output_offset == "learned"] * out_features
        resolution = check_sizes("input_resolution", self.input_resolution, in_features)
        least = check_sizes("output_scale", self.output_scale, out_features)
        return Units(
            RunningScale(in_features, shifted, grows, resolution, **options),
            RunningScale(out_features, centred, least=least, **options),
        )

    def is_rough(self, learner: Host) -> bool:
        """Whether units are adopted before the present sample is learned."""
        n = learner.n_samples
        return n & (n + 1) == 0 and n < _DOUBLING

    def before_update(self, learner: Host, x: Tensor, y: Tensor, mask: Tensor | None) -> None:
        """While units are rough, adopt them before a sample is learned, which counts."""
        n = learner.n_samples
        if not self.is_rough(learner):
            return
        if n + 1 < BLOCK:
            x, y, on, _ = learner.recent.last(n + 1, n + 1)
            self._adopt(learner, x, y, on)
            learner.learn_anew(x[..., :n, :], y[..., :n, :], on[..., :n])
            return
        self._pool(learner)
        if not learner.is_due(n + 1):  # else it comes of itself
            learner.refresh()

    def act(self, learner: Host) -> None:
        """Pool a block that is full."""
        if not self.is_rough(learner):
            self._pool(learner)

    def on_rebuild(self, learner: Host) -> None:
        """Adopt the moments: ``new z = (old z + offset) ratio``, ``new t = (old t + offset_t) ratio_t``."""
        if learner.n_samples >= BLOCK - 1:
            self._adopt(learner)

    def _pool(self, learner: Host) -> None:
        """Blocks end with the 32nd sample, and a sample before each rebuild from then on."""
        n, offset = learner.n_samples + 1, (learner.refresh_offset - _AHEAD) % BLOCK
        if n == BLOCK or (n > BLOCK and (n - offset) % BLOCK == 0):
            size = offset if offset and n == BLOCK + offset else BLOCK
            if learner.engine is None or not learner.engine.pool(learner, n, size):
                learner.units.pool(*learner.recent.last(n, size)[:3])

    def _adopt(self, learner: Host, *young: Tensor) -> None:
        posterior, units = learner.posterior, learner.units
        found = None if young or learner.engine is None else learner.engine.settle(learner)
        change, change_t = found or (units.input.settle(*young[::2]), units.output.settle(*young[1:]))
        alien = [ratio > 1.0 / ALIEN for _, ratio in filter(None, (change, change_t))]
        models = torch.cat(alien, dim=-1).any(-1) if alien else None
        if models is not None and (models.is_cuda or bool(models.any())):  # it would stay for good
            posterior.forget(models)
        if change is not None:
            posterior.basis.add_(change[0].unsqueeze(-2)).mul_(change[1].unsqueeze(-2))
        if change_t is not None:
            if self.output_offset == "learned":
                added = posterior.precision.sum(-1, keepdim=True) * change_t[0].unsqueeze(-2)
                posterior.information.add_(added)
            posterior.information.mul_(change_t[1].unsqueeze(-2))
