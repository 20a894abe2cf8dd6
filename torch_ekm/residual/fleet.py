from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any, Literal, cast

import torch
from torch import nn
from torch.distributions import Normal

from ..exceptions import ParameterError
from ..typing import Tensor
from .base import ResidualLearner
from .report import UpdateReport


class LearnerFleet(ResidualLearner):
    """n independent learners of a kind that is one model by itself: ``g_k(x_k)``, k over ``batch_shape``.

    Each does exactly what it would do alone, one after the other: n times the time of one; a learner that
    draws its weights from a seed draws the same in every place. Learners that take ``batch_shape``
    themselves (``SparseOnlineGP`` among them) update all models in one call and are much faster. This is
    for those that do not, such as ``KRLSTracker``, ``ReplayMLP`` and the adapters of other
    libraries. What is special to a kind is found on ``fleet[k]``; the law of y is taken to be normal.

    Args:
        kind: ``kind(in_features, out_features, dtype=..., device=..., **options)`` gives one learner.
        batch_shape: shape of the fleet.
        options: of each learner; kernels and other modules among them are copied for each.

    Raises:
        ParameterError: from ``kind``, or it gives something else than single learners of these sizes.
    """

    def __init__(
        self,
        kind: Callable[..., ResidualLearner],
        in_features: int,
        out_features: int,
        *,
        batch_shape: tuple[int, ...],
        on_invalid: Literal["raise", "skip"] = "raise",
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
        **options: Any,
    ) -> None:
        factory: dict[str, Any] = {"dtype": dtype, "device": device}
        super().__init__(in_features, out_features, batch_shape=batch_shape, on_invalid=on_invalid, **factory)
        self.learners = nn.ModuleList(
            kind(in_features, out_features, **copy.deepcopy(options), **factory)
            for _ in range(math.prod(self.batch_shape))
        )
        for g in self.learners:
            fits = isinstance(g, ResidualLearner) and not g.batch_shape
            if not fits or (g.in_features, g.out_features) != (self.in_features, self.out_features):
                wanted = f"giving single learners of {self.in_features} inputs, {self.out_features} outputs"
                raise ParameterError("kind", repr(g), wanted)

    def __getitem__(self, index: int | tuple[int, ...]) -> ResidualLearner:
        """The learner at this place of the fleet."""
        place = index if isinstance(index, tuple) else (index,)
        inside = len(place) == len(self.batch_shape)
        inside = inside and all(-n <= i < n for i, n in zip(place, self.batch_shape, strict=True))
        if not inside:
            raise ParameterError("index", index, f"one place in a fleet of shape {tuple(self.batch_shape)}")
        places = torch.arange(len(self.learners)).reshape(self.batch_shape)
        return self._all()[int(places[place])]

    def forward(self, x: Tensor) -> Tensor:
        return self._stack([g(z) for g, z in self._each(self.check_query(x))], 1)

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        each = self._each(self.check_query(x))
        laws = [g.predict(z, observation=observation) for g, z in each]
        mean, deviation = (self._stack([getattr(law, n) for law in laws], 1) for n in ("mean", "stddev"))
        return Normal(mean, deviation, validate_args=False)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Each learner's mean and Jacobian, closed where it has a closed form."""
        parts = [g.linearize(z) for g, z in self._each(self.check_query(x))]
        return self._stack([p[0] for p in parts], 1), self._stack([p[1] for p in parts], 2)

    def reset(self) -> None:
        self.n_refused.zero_()
        for g in self._all():
            g.reset()

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        n = len(self.learners)
        x, y = x.reshape(n, -1), y.reshape(n, -1)
        who = [None] * n if mask is None else list(mask.reshape(n))
        reports = [g._step(g._cast(x[k]), g._cast(y[k]), who[k]) for k, g in enumerate(self._all())]
        stacked = UpdateReport.stack(reports)
        return UpdateReport(*(part.reshape(self.batch_shape) for part in vars(stacked).values()))

    def _all(self) -> list[ResidualLearner]:
        return cast("list[ResidualLearner]", list(self.learners))  # checked at construction

    def _each(self, x: Tensor) -> list[tuple[ResidualLearner, Tensor]]:
        """Each learner with its queries, ``(*any, in)``."""
        lead = torch.broadcast_shapes(x.shape[:-1], self.batch_shape)
        x = x.expand(*lead, x.shape[-1])
        x = x.reshape(*lead[: len(lead) - len(self.batch_shape)], len(self.learners), x.shape[-1])
        return list(zip(self._all(), x.unbind(-2), strict=True))

    def _stack(self, parts: list[Tensor], n_last: int) -> Tensor:
        """``(*any, *last)`` of each learner as ``(*any, *batch_shape, *last)``."""
        x = torch.stack(parts, -1 - n_last)
        cut = x.dim() - n_last
        return x.reshape(*x.shape[: cut - 1], *self.batch_shape, *x.shape[cut:])
