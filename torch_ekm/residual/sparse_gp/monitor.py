"""What a learner's innovations say about itself: is its noise right, is the system still the same?"""

from __future__ import annotations

import torch
from torch import nn

from ...typing import Bool, Float, Tensor

_Z90_SQUARED = 1.6448536269514722**2
_RATE, _MEMORY = 1 / 8, 24  # of the alarm; samples kept, of which those since the change are replayed
_ALARM, _SURPRISING, _ONSET, _COOL = 0.6, 5.0, 0.12, -2.0


class NoiseCalibration(nn.Module):
    """Factors c_j on the observation noise that make 90 % intervals hold 90 % of the samples::

        log c_j += rate ([|i_j| > 1.645 sqrt(v + c_j s2_j)] - 0.1)

    Adaptive conformal inference (Gibbs & Candes, NeurIPS 2021): the long-run share of misses is 10 %
    whatever the law of the noise, per output, without touching the mean or the gain.

    Args:
        out_features: number of outputs.
        rate: of the logarithm.
        batch_shape: shape of the fleet.
    """

    log_factor: Tensor

    def __init__(
        self,
        out_features: int,
        *,
        rate: float = 0.2,
        batch_shape: tuple[int, ...] = (),
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        self.rate = rate
        factor = torch.zeros(*batch_shape, out_features, dtype=torch.float64, device=device)
        self.register_buffer("log_factor", factor)

    def observe(self, innovation: Tensor, latent: Tensor, noise: Tensor, mask: Tensor | None) -> None:
        """One innovation ``(*batch, out)`` with its latent ``(*batch)`` and noise variance."""
        variance = latent.unsqueeze(-1) + noise * self.log_factor.exp()
        step = self.rate * ((innovation.square() > _Z90_SQUARED * variance).to(noise.dtype) - 0.1)
        self.log_factor += step if mask is None else step * mask.unsqueeze(-1)
        self.log_factor.clamp_(-5.0, 10.0)

    def reset(self) -> None:
        """c = 1."""
        self.log_factor.zero_()


class ChangeDetector(nn.Module):
    """An alarm when most of the last samples were surprising: not outliers, another system::

        a += ([z2 > 5] - a)/8,   alarm: a > 0.6

    A tenth of gross outliers never reaches it; an abrupt change does within eight samples or some more.
    The samples since ``a`` last lay below what a single surprise raises it to are the new system's: the
    learner can start anew from them. After an alarm it waits before the next.
    """

    level: Tensor
    inputs: Tensor
    targets: Tensor
    levels: Tensor

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        batch_shape: tuple[int, ...] = (),
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        factory = {"dtype": torch.float64, "device": device}
        self.register_buffer("level", torch.zeros(batch_shape, **factory))
        # newest last; shifted rather than indexed, so that masks need no pointers
        self.register_buffer("inputs", torch.zeros(_MEMORY, *batch_shape, in_features, **factory))
        self.register_buffer("targets", torch.zeros(_MEMORY, *batch_shape, out_features, **factory))
        self.register_buffer("levels", torch.zeros(_MEMORY, *batch_shape, **factory))

    def observe(
        self,
        x: Float[Tensor, "*batch in"],
        y: Float[Tensor, "*batch out"],
        surprise: Float[Tensor, "*batch"],
        mask: Tensor | None,
    ) -> Bool[Tensor, "*batch"]:
        """Take a sample in; tells which models face another system."""
        step = _RATE * ((surprise > _SURPRISING).to(x.dtype) - self.level)
        self.level += step if mask is None else step * mask
        level = self.level if mask is None else self.level.where(mask > 0, torch.inf)  # inf: no sample
        for kept, new in ((self.inputs, x), (self.targets, y), (self.levels, level)):
            kept.copy_(torch.cat([kept[1:], new.unsqueeze(0)]))
        alarm = self.level > _ALARM
        self.level.masked_fill_(alarm, _COOL)
        return alarm

    @property
    def since_change(self) -> Bool[Tensor, "*memory_and_batch"]:
        """Which of the kept samples belong to the new system, at an alarm."""
        later = (self.levels >= _ONSET).to(torch.int64).flip(0).cumprod(0).flip(0)
        return (later > 0) & self.levels.isfinite()

    def reset(self) -> None:
        """Nothing seen."""
        for buffer in self.buffers():
            buffer.zero_()
