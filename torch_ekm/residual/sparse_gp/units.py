from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch

from ..._checks import check_sizes
from ...exceptions import ParameterError
from ...typing import Tensor
from ..running_scale import ALIEN, BLOCK, RunningScale
from . import plan as P
from .part import Host, Part, Units

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
        """Running moments of x and y, 0 and 1 at the start."""
        like = learner.posterior.basis
        fleet = {"batch_shape": learner.posterior.batch_shape, "dtype": like.dtype, "device": like.device}
        shifted = learner.kernel.shift_invariant(learner.in_features)
        centred = [self.output_offset == "learned"] * learner.out_features
        grows = learner.kernel.grows(learner.in_features)
        resolution = check_sizes("input_resolution", self.input_resolution, learner.in_features)
        least = check_sizes("output_scale", self.output_scale, learner.out_features)
        self.input = RunningScale(learner.in_features, shifted, grows, resolution, **fleet)
        self.output = RunningScale(learner.out_features, centred, least=least, **fleet)
        learner.units = Units(self.input, self.output, centred=self.output_offset == "learned")

    def compiled(self) -> dict[int, Tensor | int]:
        """Where compiled loops keep samples, see :mod:`.plan`."""
        x, y = self.input, self.output
        return {
            P.BLOCK: x.block, P.BLOCK_ON: x.block_on, P.BLOCK_Y: y.block, P.BLOCK_ON_Y: y.block_on,
            P.BLOCK_SIZE: BLOCK,
        }  # fmt: skip

    def place(self, n: int, learner: Host) -> int:
        """Of the sample after n in the block, which is full just before a rebuild."""
        return n if n < BLOCK else (n - learner.refresh_offset) % BLOCK

    def acts_before(self, n: int, learner: Host) -> bool:
        """Whether it does more before the sample after n than keep it."""
        return n == BLOCK or self.place(n, learner) == BLOCK - 1 or (n & (n + 1) == 0 and n < _DOUBLING)

    def before_update(self, learner: Host, x: Tensor, y: Tensor, mask: Tensor | None) -> None:
        """Take the sample in; while units are rough, adopt them before it is learned."""
        n = learner.n_samples
        place = self.place(n, learner)
        if n == BLOCK and place > 0:  # what is behind was pooled already
            self.input.block_on.zero_()
            self.output.block_on.zero_()
        self.input.observe(place, x, mask)
        self.output.observe(place, y, mask)
        if n & (n + 1) == 0 and n < _DOUBLING:
            if n + 1 < BLOCK:
                self._adopt(learner, young=True)
                x, y, on = self.input.block, self.output.block, self.input.block_on
                learner.learn_anew(x[..., :n, :], y[..., :n, :], on[..., :n, 0])
            elif not learner.is_due(n + 1):  # else it comes of itself
                learner.refresh()

    def on_rebuild(self, learner: Host) -> None:
        """Adopt the moments: ``new z = (old z + offset) ratio``, ``new t = (old t + offset_t) ratio_t``."""
        if learner.n_samples >= BLOCK - 1:
            self._adopt(learner)

    def _adopt(self, learner: Host, young: bool = False) -> None:
        posterior = learner.posterior
        offset, ratio = self.input.settle(young=young)
        offset_t, ratio_t = self.output.settle(young=young)
        alien = (torch.cat([ratio, ratio_t], dim=-1) > 1.0 / ALIEN).any(-1)
        if alien.is_cuda or bool(alien.any()):  # what is of another size would stay for good
            posterior.forget(alien)
        posterior.basis.add_(offset.unsqueeze(-2)).mul_(ratio.unsqueeze(-2))
        if self.output_offset == "learned":
            posterior.information.add_(posterior.precision.sum(-1, keepdim=True) * offset_t.unsqueeze(-2))
        posterior.information.mul_(ratio_t.unsqueeze(-2))

    def reset(self) -> None:
        """Back to z = x, t = y."""
        self.input.reset()
        self.output.reset()
