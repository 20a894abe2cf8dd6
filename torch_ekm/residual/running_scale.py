from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from .._arrays import is_plain, namespace
from ..typing import Bool, Float, Tensor

BLOCK = 32  #: samples of a block
TRIMMED = (8.0, 4.0)  # an eighth, or a fourth of a block
# below this share of what the eighth leaves in, the rest stands still and these are no outliers
SPIKES = 0.03
CLIP = 5.5  # of the trimmed rms, 3.3 deviations of a normal law
BURST_CLIP = 10.0  # times as much for columns whose large samples come in company
COMPANY = 0.5  # of what chance would leave alone
DOUBT = 2.0  # so many large ones are taken to be alone beforehand
REST = 0.1, 0.05  # a block that varies less than this share of all before has this weight: it stands still
REACH = 10.0  #: scales beyond which z goes no further, in columns where that matters
SETTLED = 0.1  #: relative change of a scale (of a shift in units of it) that is not worth new units
ALIEN = 1e-20  #: a variation below this share is no rest either: what was before was wrong


class RunningScale(nn.Module):
    """``z = (x - shift) / scale`` of columns whose units are unknown; columns may be exempt from the shift.

    In each block, samples farther from the median than a normal law would hold are clipped to that distance.
    Its deviation is estimated without the fourth that lies farthest out (the eighth, where the others hardly
    move: these are no outliers). Mean and root of the spread of what is left are pooled over the last
    ``memory`` samples. Where large samples come in company, next to each other in time much more often than
    chance has it, they are bursts of motion and ten times as much is left. So outliers decide nothing, a
    stream that starts at rest gets its units when it moves, one that comes to rest keeps them, and slow
    changes are followed. A column that has not varied keeps scale 1.
    Exempt columns are scaled by their root mean square. Nothing is squared before it is divided by the
    largest: 1e150 is a number like others. A past that is 1e20 times as large as what comes is forgotten.

    :meth:`pool` takes a block of samples in, :meth:`settle` adopts what was found. In between ``shift`` and
    ``scale`` stand still, so that what was computed with them stays valid.

    An input that stood still has the scale of its jitter until it moves: then its z is of any size. What
    grows with z without end takes it for ``REACH`` at most.

    Args:
        features: width of x.
        shifted: columns that are centred (none by default).
        grows: columns whose z is cut (none by default).
        least: smallest scale of each column, and the first; 0: there is none, and 1 is the first.
        batch_shape: shape of the fleet.
    """

    memory = 2000  #: samples over which mean and spread are pooled

    def __init__(
        self,
        features: int,
        shifted: list[bool] | None = None,
        grows: list[bool] | None = None,
        least: list[float] | None = None,
        *,
        batch_shape: tuple[int, ...] = (),
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        shape, factory = (*batch_shape, features), {"dtype": dtype, "device": device}
        self.shift = nn.Buffer(torch.zeros(shape, **factory))
        self.least = nn.Buffer(torch.tensor(least or [0.0] * features, **factory), persistent=False)
        self.scale = nn.Buffer(self._first().expand(shape).clone())
        self.centre = nn.Buffer(torch.zeros(shape, **factory))
        self.spread = nn.Buffer(torch.zeros(shape, **factory))
        self.weight = nn.Buffer(torch.zeros(shape, **factory))
        self.large = nn.Buffer(torch.zeros(*shape, 2, **factory))  # large samples, and those of them alone
        columns = torch.tensor(shifted or [False] * features, **factory)
        self.shifted = nn.Buffer(columns)
        self.cuts = any(grows or ())
        reach = [REACH if cut else math.inf for cut in grows or [False] * features]
        self.reach = nn.Buffer(torch.tensor(reach, **factory), persistent=False)

    def state_problems(self, state: Mapping[str, Any]) -> list[str]:
        """What is wrong with the entries of a state that is to be loaded."""
        return [] if bool((state["scale"] > 0).all()) else ["scale is not above 0"]

    def forward(self, x: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """x in the learner's units."""
        return self._cut((x - self.shift) / self.scale)

    def of_sets(self, x: Float[Tensor, "*batch n features"]) -> Float[Tensor, "*batch n features"]:
        """n samples of each model in the learner's units."""
        return self._cut((x - self.shift.unsqueeze(-2)) / self.scale.unsqueeze(-2))

    def _cut(self, z: Tensor) -> Tensor:
        return z.clamp(-self.reach, self.reach) if self.cuts else z

    def follows(self, z: Float[Tensor, "*any features"]) -> Bool[Tensor, "*any features"]:
        """Columns in which z changes with x: where it was not cut."""
        return z.abs() < self.reach

    def pool(self, block: Float[Tensor, "*batch n features"], on: Float[Tensor, "*batch n"]) -> None:
        """Take samples in, in their order, of the models where ``on`` is 1."""
        pooled = self.weight, self.centre, self.spread, self.large
        for buffer, found in zip(pooled, _pooled(self, block, on), strict=True):
            buffer.copy_(found)

    def settle(self, *young: Tensor, settled: float = SETTLED) -> tuple[Tensor, Tensor] | None:
        """Adopt what was found; returns the change as ``(offset, ratio)``: new z = (old z + offset) * ratio.

        None: no change is worth it.

        Args:
            young: a block as of :meth:`pool` that counts, too; every change is worth new units then.
            settled: as SETTLED.
        """
        found = _pooled(self, *young)[:3] if young else (self.weight, self.centre, self.spread)
        now: Any = *found, self.scale, self.shift, self.least
        now = [t.numpy() for t in now] if is_plain(self.scale) else now  # see _arrays: small operations
        (weight, centre, spread, old_scale, old_shift, least), xp = now, namespace(now[0])
        kind = torch.finfo(self.scale.dtype)
        usable = (spread > 100 * kind.eps * abs(centre)) & (spread > kind.tiny)
        scale = xp.where(usable, xp.maximum(spread, least), xp.where(least > 0, least, 1.0))
        off = xp.maximum(scale / old_scale, old_scale / scale) - 1.0
        off = off + abs(centre - old_shift) / xp.minimum(scale, old_scale)
        change = (weight > 0) & (off > (0.0 if young else settled))
        if xp is np and not change.any():
            return None
        scale, shift = xp.where(change, scale, old_scale), xp.where(change, centre, old_shift)
        offset, ratio = (old_shift - shift) / old_scale, old_scale / scale
        for buffer, value in ((self.shift, shift), (self.scale, scale)):
            buffer.copy_(torch.as_tensor(value))
        return torch.as_tensor(offset), torch.as_tensor(ratio)

    def forget(self, models: Bool[Tensor, "*batch"]) -> None:
        """What comes decides alone on these models' scales; until then they are what they were."""
        for buffer in (self.weight, self.centre, self.spread):
            buffer.masked_fill_(models.unsqueeze(-1), 0.0)
        self.large.masked_fill_(models[..., None, None], 0.0)

    def reset(self) -> None:
        """Forget all samples: shift 0 and scale 1 again."""
        for buffer in (self.shift, self.centre, self.spread, self.weight, self.large):
            buffer.zero_()
        self.scale.copy_(self._first())

    def _first(self) -> Float[Tensor, " features"]:
        return torch.where(self.least > 0, self.least, 1.0)


class Units(nn.Module):
    """The units in which a learner works, ``z = (x - shift) / scale``, and y the same: 0 and 1 at first.

    Args:
        input, output: scales of x and y.
    """

    def __init__(self, input: RunningScale, output: RunningScale) -> None:
        super().__init__()
        self.input, self.output = input, output

    def of_sets(
        self, x: Float[Tensor, "*batch n in"], y: Float[Tensor, "*batch n out"]
    ) -> tuple[Tensor, Tensor]:
        """n samples of each model in the learner's units."""
        return self.input.of_sets(x), self.output.of_sets(y)

    def value(self, value: Float[Tensor, "*any out_or_1"], power: int) -> Tensor:
        """An output in its own unit, or (power 2) a variance in its square."""
        scale = self.output.scale
        return value * scale + self.output.shift if power == 1 else value * scale.square()

    def slope(
        self, slope: Float[Tensor, "*any out_or_1 in"], power: int, z: Float[Tensor, "*any in"]
    ) -> Float[Tensor, "*any out in"]:
        """The derivative of such a value by x; z is that x in the learner's units."""
        slope = slope * self.output.scale.pow(power).unsqueeze(-1) / self.input.scale.unsqueeze(-2)
        return slope * self.input.follows(z).unsqueeze(-2) if self.input.cuts else slope

    def pool(self, x: Tensor, y: Tensor, on: Tensor) -> None:
        """Take a block in, see RunningScale."""
        self.input.pool(x, on)
        self.output.pool(y, on)

    def reset(self) -> None:
        """Back to z = x, t = y."""
        self.input.reset()
        self.output.reset()


def _pooled(
    at: RunningScale, block: Float[Tensor, "*batch n features"], on: Float[Tensor, "*batch n"]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Weight, centre, spread and large samples of the past and the block together."""
    tiny = torch.finfo(block.dtype).tiny
    count, centre, spread, large = _of_block(at, block, on.unsqueeze(-1), tiny)
    past = torch.where((spread == 0) | (spread > ALIEN * at.spread), at.spread, 0.0)
    count = torch.where(spread < REST[0] * past, REST[1] * count, count)
    before = torch.where(past == at.spread, at.weight.clamp_max(at.memory), 0.0)
    weight = before + count
    part = count / weight.clamp_min(tiny)
    gap = torch.where(before > 0, centre - at.centre, 0.0)
    most = torch.maximum(torch.maximum(gap.abs(), past), spread).clamp_min(tiny)
    # mean of roots: a block full of outliers does not decide either
    inside = (1.0 - part) * (past / most) ** 0.5 + part * (spread / most) ** 0.5
    variance = inside**4 + (1.0 - part) * part * (gap / most) ** 2
    start = torch.where(before > 0, at.centre, centre)
    return weight, start + part * gap, most * variance**0.5, large


def _of_block(at: RunningScale, block: Tensor, block_on: Tensor, tiny: float) -> tuple[Tensor, ...]:
    """Number of samples, centre and spread of the block without its outliers; large ones up to now."""
    on, count = block_on > 0, block_on.sum(-2)
    n, rank = count.unsqueeze(-2), torch.arange(block.shape[-2], device=block.device).unsqueeze(-1)
    ordered = torch.where(on, block, torch.inf).sort(-2).values
    middle = torch.where(rank == (n - 1.0).clamp_min(0.0) // 2, ordered, 0.0).sum(-2)
    middle = torch.where(at.shifted * count > 0, middle, 0.0)
    away = torch.where(on, block - middle.unsqueeze(-2), 0.0)
    most = away.abs().amax(-2).clamp_min(tiny)
    away = away / most.unsqueeze(-2)
    # those farthest out are left out of the measure by which they are cut
    squares = torch.where(on, away**2, torch.inf).sort(-2).values
    few, many = (
        (torch.where(kept, squares, 0.0).sum(-2) / kept.sum(-2).clamp_min(1)) ** 0.5
        for kept in (rank < n - (n / part).ceil() for part in TRIMMED)
    )
    typical = torch.where(many > SPIKES * few, many, few)
    bound = torch.where(typical > 0, CLIP * typical, 1.0)
    large, bursts = _in_company(at, away.abs() > bound.unsqueeze(-2), count)
    bound = torch.where(bursts, BURST_CLIP * bound, bound).unsqueeze(-2)
    away = torch.minimum(torch.maximum(away, -bound), bound)
    n = count.clamp_min(1.0)
    mean = (away.sum(-2) / n) * at.shifted
    spread = ((away - mean.unsqueeze(-2)) ** 2 * block_on).sum(-2) / n
    return count + 0 * mean, middle + most * mean, most * spread**0.5, large


def _in_company(at: RunningScale, large: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Counts of large samples with those of this block, and whether they come in bursts."""
    near = torch.zeros_like(large)
    near[..., 1:, :] = large[..., :-1, :]
    near[..., :-1, :] |= large[..., 1:, :]
    found = torch.stack([large.sum(-2), (large & ~near).sum(-2)], -1)
    counts = at.large * (1.0 - BLOCK / at.memory) + found
    share = counts[..., 0] / (at.weight.clamp_max(at.memory) + count).clamp_min(1.0)
    by_chance = (1.0 - share.clamp_max(1.0)) ** 2
    return counts, counts[..., 1] + DOUBT < COMPANY * by_chance * (counts[..., 0] + DOUBT)
