from __future__ import annotations

import torch
from torch import nn

from ..typing import Float, Tensor

BLOCK = 32  #: samples of a block; those before the first one is full count from the first on
_TRIMMED = (8.0, 4.0)  # an eighth, or a fourth of a block
# below this share of what the eighth leaves in, the rest stands still and these are no outliers
_SPIKES = 0.03
_CLIP = 5.5  # of the trimmed rms, 3.3 deviations of a normal law
_BURST_CLIP = 10.0  # times as much for columns whose large samples come in company
_COMPANY = 0.5  # of what chance would leave alone
_DOUBT = 2.0  # so many large ones are taken to be alone beforehand
_REST = 0.1, 0.05  # a block that varies less than this share of all before has this weight: it stands still
ALIEN = 1e-20  #: a variation below this share is no rest either: what was before was wrong


def write(buffer: Float[Tensor, "*batch places n"], place: int, values: Float[Tensor, "*batch n"]) -> None:
    """``buffer[..., place, :] = values``, which takes torch three times as long."""
    buffer.select(-2, place).copy_(values)


class RunningScale(nn.Module):
    """``z = (x - shift) / scale`` of columns whose units are unknown; columns may be exempt from the shift.

    Of each block of samples the fourth that lies farthest from its median is cut to what a normal law like
    that of the others would hold (the eighth, where the others hardly move: these are no outliers). Mean and
    root of the spread of what is left are pooled over the last ``memory`` samples. Where large samples
    come in company, next to each other in time much more often than chance has it, they are bursts of motion
    and ten times as much is left. So outliers decide
    nothing, a stream that starts at rest gets its units when it moves, one that comes to rest keeps them,
    and slow changes are followed. A column that has not varied keeps scale 1.
    Exempt columns are scaled by their root mean square. Nothing is squared before it is divided by the
    largest: 1e150 is a number like others. A past that is 1e20 times as large as what comes is forgotten.

    :meth:`observe` takes samples in, :meth:`settle` adopts what was found. In between ``shift`` and ``scale``
    stand still, so that what was computed with them stays valid.

    Args:
        features: width of x.
        shifted: columns that are centred (none by default).
        batch_shape: shape of the fleet.
    """

    memory = 2000  #: samples over which mean and spread are pooled

    def __init__(
        self,
        features: int,
        shifted: list[bool] | None = None,
        *,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        shape, factory = (*batch_shape, features), {"dtype": dtype, "device": device}
        self.shift = nn.Buffer(torch.zeros(shape, **factory))
        self.scale = nn.Buffer(torch.ones(shape, **factory))
        self.centre = nn.Buffer(torch.zeros(shape, **factory))
        self.spread = nn.Buffer(torch.zeros(shape, **factory))
        self.weight = nn.Buffer(torch.zeros(shape, **factory))
        self.large = nn.Buffer(torch.zeros(*shape, 2, **factory))  # large samples, and those of them alone
        self.block = nn.Buffer(torch.zeros(*batch_shape, BLOCK, features, **factory))
        self.block_on = nn.Buffer(torch.zeros(*batch_shape, BLOCK, 1, **factory))
        columns = torch.tensor(shifted or [False] * features, dtype=dtype, device=device)
        self.shifted = nn.Buffer(columns)

    def forward(self, x: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """x, or its first columns, in the learner's units."""
        n = x.shape[-1]
        return (x - self.shift[..., :n]) / self.scale[..., :n]

    def of_sets(self, x: Float[Tensor, "*batch n features"]) -> Float[Tensor, "*batch n features"]:
        """n samples of each model in the learner's units."""
        return (x - self.shift.unsqueeze(-2)) / self.scale.unsqueeze(-2)

    def observe(self, place: int, x: Float[Tensor, "*batch features"], on: Tensor | None) -> None:
        """A sample ``(*batch, features)`` of the models ``on``, at its place in the block; the last pools.

        ``on`` None: all models.
        """
        write(self.block, place, x)
        row = self.block_on.select(-2, place)
        row.fill_(1.0) if on is None else row.copy_(on.unsqueeze(-1))
        if place == BLOCK - 1:
            pooled = self.weight, self.centre, self.spread, self.large
            for buffer, found in zip(pooled, self._pooled(), strict=True):
                buffer.copy_(found)

    def settle(self, *, young: bool = False, settled: float = 0.1) -> tuple[Tensor, Tensor]:
        """Adopt what was found; returns the change as ``(offset, ratio)``: new z = (old z + offset) * ratio.

        Args:
            young: the block that is not yet full counts, and every change is worth new units.
            settled: relative change of a scale (of a shift in units of it) that is not worth new units.
        """
        weight, centre, spread = self._pooled()[:3] if young else (self.weight, self.centre, self.spread)
        floor = 100 * torch.finfo(spread.dtype).eps * centre.abs()
        usable = (spread > floor) & (spread > torch.finfo(spread.dtype).tiny)
        scale = torch.where(usable, spread, 1.0)
        off = torch.maximum(scale / self.scale, self.scale / scale) - 1.0
        off = off + (centre - self.shift).abs() / torch.minimum(scale, self.scale)
        change = (weight > 0) & (off > (0.0 if young else settled))
        scale, shift = torch.where(change, scale, self.scale), torch.where(change, centre, self.shift)
        offset, ratio = (self.shift - shift) / self.scale, self.scale / scale
        self.shift.copy_(shift)
        self.scale.copy_(scale)
        return offset, ratio

    def _pooled(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Weight, centre, spread and large samples of the past and the block together."""
        count, centre, spread, large = self._of_block()
        share, drop = _REST
        past = self.spread.where((spread == 0) | (spread > ALIEN * self.spread), 0.0)
        count = count * torch.where(spread < share * past, drop, 1.0)
        before = self.weight.clamp_max(self.memory).where(past == self.spread, 0.0)
        weight = before + count
        part = count / weight.clamp_min(torch.finfo(count.dtype).tiny)
        gap = (centre - self.centre).where(before > 0, 0.0)
        most = torch.stack([gap.abs(), past, spread]).amax(0).clamp_min(torch.finfo(count.dtype).tiny)
        # mean of roots: a block full of outliers does not decide either
        inside = (1.0 - part) * (past / most).sqrt() + part * (spread / most).sqrt()
        variance = inside.pow(4) + (1.0 - part) * part * (gap / most).square()
        start = torch.where(before > 0, self.centre, centre)
        return weight, start + part * gap, most * variance.sqrt(), large

    def _of_block(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Number of samples, centre and spread of the block without its outliers; large ones up to now."""
        on = self.block_on > 0
        count = self.block_on.sum(-2)
        last = (count.to(torch.int64) - 1).clamp_min(0)
        ordered = torch.where(on, self.block, torch.inf).sort(dim=-2).values
        middle = ordered.gather(-2, (last // 2).unsqueeze(-2).expand_as(ordered[..., :1, :]))
        middle = middle.where(self.shifted * count.unsqueeze(-2) > 0, 0.0)
        away = torch.where(on, self.block - middle, 0.0)
        most = away.abs().amax(-2, keepdim=True).clamp_min(torch.finfo(away.dtype).tiny)
        away = away / most
        # those farthest out are left out of the measure by which they are cut
        squares = torch.where(on, away.square(), -1.0).sort(dim=-2, descending=True).values
        rank, n = torch.arange(BLOCK, device=away.device).unsqueeze(-1), count.unsqueeze(-2)
        few, many = (
            ((squares * kept).sum(-2) / kept.sum(-2).clamp_min(1.0)).sqrt().unsqueeze(-2)
            for kept in ((rank >= (n / part).ceil()) & (squares >= 0) for part in _TRIMMED)
        )
        typical = torch.where(many > _SPIKES * few, many, few)
        bound = torch.where(typical > 0, _CLIP * typical, 1.0)
        large, bursts = self._in_company(away.abs() > bound, count)
        bound = bound * torch.where(bursts, _BURST_CLIP, 1.0).unsqueeze(-2)
        away = torch.minimum(torch.maximum(away, -bound), bound)
        n = count.clamp_min(1.0)
        mean = (away.sum(-2) / n) * self.shifted
        spread = ((away - mean.unsqueeze(-2)).square() * self.block_on).sum(-2) / n
        most, middle = most.squeeze(-2), middle.squeeze(-2)
        return count.expand_as(mean), middle + most * mean, most * spread.sqrt(), large

    def _in_company(self, large: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
        """Counts of large samples with those of this block, and whether they come in bursts."""
        padded = torch.nn.functional.pad(large, (0, 0, 1, 1))
        alone = large & ~(padded[..., :-2, :] | padded[..., 2:, :])
        found = torch.stack([large.sum(-2), alone.sum(-2)], dim=-1).to(self.large)
        counts = self.large * (1.0 - BLOCK / self.memory) + found
        share = counts[..., 0] / (self.weight.clamp_max(self.memory) + count)
        by_chance = (1.0 - share.clamp_max(1.0)).square()
        return counts, counts[..., 1] + _DOUBT < _COMPANY * by_chance * (counts[..., 0] + _DOUBT)

    def reset(self) -> None:
        """Forget all samples: shift 0 and scale 1 again."""
        kept = self.shift, self.centre, self.spread, self.weight, self.large, self.block, self.block_on
        for buffer in kept:
            buffer.zero_()
        self.scale.fill_(1.0)

    def extra_repr(self) -> str:
        if self.scale.numel() > 12:
            return f"features={self.scale.shape[-1]}"
        shift, scale = ([float(f"{v:.3g}") for v in b.flatten().tolist()] for b in (self.shift, self.scale))
        return f"shift={shift}, scale={scale}"
