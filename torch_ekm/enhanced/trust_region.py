"""How far a motion may go: as far as what was predicted of the last ones came true."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from .._recorded import Recorded
from ..exceptions import ParameterError
from ..typing import Float, Tensor

_DEG = math.pi / 180


@dataclass(frozen=True)
class TrustOptions:
    """Figures of a :class:`TrustRegion`."""

    start: float = 0.7
    """Pace with an object that is new."""
    smallest: float = 0.5
    largest: float = 2.0
    agree: float = 1.0
    """rho up to which the pace grows."""
    disagree: float = 1.6
    """rho from which it shrinks."""
    grow: float = 1.2
    shrink: float = 0.7
    relative: float = 0.12
    """Error that is no surprise, as a share of the motion; of a translation the contacts' way counts."""
    translation_noise: float = 0.3e-3
    """Standard deviation of a measured motion [m]."""
    rotation_noise: float = 0.3 * _DEG
    """[rad]"""
    force_noise: float = 0.5
    """[N]"""
    used: float = 0.7
    """A motion below this share of what was allowed says nothing for a larger one."""

    def __post_init__(self) -> None:
        if not 0 < self.smallest <= self.start <= self.largest:
            valid = f"between smallest and largest, {self.smallest:g} to {self.largest:g}"
            raise ParameterError("start", self.start, valid)
        if not (0 < self.agree < self.disagree and 0 < self.shrink < 1 <= self.grow):
            figures = (self.agree, self.disagree, self.shrink, self.grow)
            valid = "0 < agree < disagree, 0 < shrink < 1 <= grow"
            raise ParameterError("agree, disagree, shrink, grow", figures, valid)
        for name in ("relative", "translation_noise", "rotation_noise", "force_noise"):
            if not getattr(self, name) > 0:
                raise ParameterError(name, getattr(self, name), "greater than 0")


class TrustRegion(Recorded, nn.Module):
    """``pace <- pace * grow`` where ``rho < agree``, ``pace * shrink`` where ``rho > disagree``, with::

        rho^2 = mean_i (dx_i - predicted_i)^2 / (noise_i^2 + (relative_i |predicted|)^2)

    over the object's twist in all six directions and the normal forces: 1 is an error that the sensors' noise
    and ``relative`` of the motion explain. The pace multiplies the largest step of
    :class:`~torch_ekm.control.LimitingFunction`. It is kept with the learner, as what is known of an object:
    a new grasp goes on where the last one ended.

    Args:
        options: figures.

    Source: trust regions of nonlinear optimisation, Conn, Gould and Toint, Trust-Region Methods (2000), with
    the measured motion in the place of the cost.
    """

    def __init__(self, options: TrustOptions | None = None) -> None:
        super().__init__()
        self.options = TrustOptions() if options is None else options
        self.value = nn.Buffer(torch.tensor(self.options.start, dtype=torch.float64))

    @property
    def pace(self) -> float:
        """Factor of the largest step."""
        return float(self.value)

    def judge(
        self,
        predicted: Float[Tensor, " 6"],
        came: Float[Tensor, " 6"],
        lever: float,
        share: float = 1.0,
        surprise: Float[Tensor, " n_c"] | None = None,
    ) -> float:
        """Learn from one motion; rho.

        Args:
            predicted: twist of the object that the model promised for what the encoders did [m, rad].
            came: as measured.
            lever: of the contacts about the object's point [m].
            share: of the largest step that was asked for.
            surprise: normal forces at the contacts, as measured less predicted [N]; None: unknown.
        """
        unit = predicted.new_tensor([lever] * 3 + [1.0] * 3)
        o = self.options
        size = torch.linalg.vector_norm(predicted / unit)
        noise = predicted.new_tensor([o.translation_noise] * 3 + [o.rotation_noise] * 3)
        terms = (came - predicted).square() / (noise.square() + (o.relative * size * unit).square())
        if surprise is not None:
            terms = torch.cat([terms, (surprise / o.force_noise).square()])
        rho = float(terms.mean().sqrt())
        if rho > o.disagree:
            self.slower()
        elif rho < o.agree and share >= o.used:
            self.value.mul_(o.grow).clamp_(max=o.largest)
        return rho

    def slower(self) -> None:
        """Shrink once."""
        least = min(self.pace, self.options.smallest)
        self.value.mul_(self.options.shrink).clamp_(min=least)

    def restart(self) -> None:
        """Begin again with half the smallest steps: something went wrong, and is near."""
        self.value.fill_(self.options.smallest / 2)

    def extra_repr(self) -> str:
        return f"pace={self.pace:.3g}"
