"""The engine of a mixture: its buffers, and those of its learners, as compiled loops see them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch.distributions import StudentT

from ..typing import Tensor
from .report import UpdateReport
from .sparse_gp import plan as P
from .sparse_gp.engine.binding import Bound, Engine, Plan
from .sparse_gp.engine.compiled import CompiledEngine, is_plain_one, on_array
from .sparse_gp.engine.loading import load_loops


def warm_up() -> bool:
    """Load the compiled loops now, not at the first update; returns whether there are any (extra ``fast``).

    A fresh installation compiles them first, for about a minute. Without this call another process does so
    meanwhile, and torch does the work.
    """
    return load_loops(wait=True) is not None


class Answer(NamedTuple):
    """What a query of one sample per model gives; what was not wanted is empty."""

    mean: Tensor
    variance: Tensor  #: of g
    standard: Tensor  #: deviation of y by which innovations are standardised
    jacobian: Tensor  #: of the mean
    slope: Tensor  #: of the variance


class BoundMixture(Bound):
    """A mixture's memory, and that of its learners, the last of which is of the noise."""

    def __init__(self, plans: list[Plan], learners: list[Any]) -> None:
        super().__init__()
        self.plans, self.learners = plans, learners
        self.members = np.stack([plan.row for plan in plans])


class CompiledMixture(Engine):
    """Updates and queries of one sample per model, on the memory of the mixture and its learners.

    Bound again whenever a buffer is another one. Torch does the work where loops do not know a learner.
    """

    def __init__(self) -> None:
        self._bound: BoundMixture | None = None

    # -- calls ----------------------------------------------------------------------------------

    def ask(self, g: Any, x: Tensor, *wanted: str) -> Answer | None:
        """One query per model for these fields of an Answer; None: torch must do it."""
        bound = self._takes(g, x)
        if bound is None:
            return None
        plans = bound.plans
        x, one, n = x.contiguous(), (*g.batch_shape, g.out_features), len(plans)
        two = *one, g.in_features
        shapes = zip(Answer._fields, (one, one, one, two, two), strict=True)
        found = Answer(*(x.new_empty(s if name == "mean" or name in wanted else 0) for name, s in shapes))
        addresses = [t.data_ptr() for t in found]
        wants = True, any(addresses[1:3]), *map(bool, addresses[3:])
        shapes = ((n, *s) if want else (0,) for s, want in zip((one, one, two, two), wants, strict=True))
        told = [x.new_empty(shape) for shape in shapes]  # by each learner
        each, sizes = [t.data_ptr() for t in told], [8 * t.numel() // n for t in told]
        loops = load_loops()
        for i, plan in enumerate(plans if wants[1] else plans[:-1]):
            at = (begin + i * size for begin, size in zip(each, sizes, strict=True))
            loops.query_fleet(plan.row, False, x.data_ptr(), *at)
        loops.mix_fleet(bound.row, bound.members, *each, *addresses)
        return found

    def learn(self, g: Any, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport | None:
        """All that an update does; None: torch must do it."""
        bound = self._takes(g, x)
        if bound is None or not is_plain_one(y, (*g.batch_shape, g.out_features)):
            return None
        pairs = list(zip(bound.plans, bound.learners, strict=True))
        if any(plan.is_rough(one) for plan, one in pairs):  # what it predicts would be another after that
            return None
        x, y = x.contiguous(), y.contiguous()
        of_all, said = np.empty((4, len(bound.all))), np.empty((2, y.numel()))
        numbers = np.array([one.n_samples for one in bound.learners])
        alarm = load_loops().update_mixture(
            bound.row, bound.members, numbers, on_array(bound, mask), x.data_ptr(), y.data_ptr(), said, of_all
        )
        if alarm < 0:  # not finite
            return None
        for i, (plan, one) in enumerate(pairs):
            if i < len(pairs) - 1 or alarm >> i & 1:  # the last one's bit: the noise has learned
                plan.act(one, bool(alarm >> i & 1))
        if g.returns is not None and (mask is None or bool(mask)):
            g.note_return(x, y.numpy(), said, float(of_all[0, 0]))
        nis, novelty, weight, event = torch.from_numpy(of_all.reshape(4, *g.batch_shape)).unbind()
        return UpdateReport(event.to(torch.int64), novelty, nis, weight)

    # -- what they work on ----------------------------------------------------------------------

    def _takes(self, g: Any, x: Tensor) -> BoundMixture | None:
        """The buffers, where this call is one for compiled loops; binds them."""
        if torch.compiler.is_compiling() or not is_plain_one(x, (*g.batch_shape, g.in_features)):
            return None
        if g.dtype != torch.float64 or load_loops() is None:
            return None
        bound = self._bound
        if bound is None or not bound.is_current():
            with g.lock:  # of two threads one binds, between two updates
                if self._bound is None or not self._bound.is_current():
                    learners = [*g.members, g.noise.gp]
                    plans = [plan for plan in map(_plan, learners) if plan is not None]
                    self._bound = self._bind(g, plans, learners) if len(plans) == len(learners) else None
                bound = self._bound
        if bound is None or not bound.usable:
            return None
        return bound if all(plan.follows(g.lock) for plan in bound.plans) else None

    def _bind(self, g: Any, plans: list[Plan], learners: list[Any]) -> BoundMixture:
        bound, tails = BoundMixture(plans, learners), g.tails
        at_zero = StudentT(tails.freedoms).log_prob(torch.zeros_like(tails.freedoms))
        fields = {
            P.LARGEST: g.largest, P.EXPERTS: g._experts, P.PRIOR: g.prior, P.EVIDENCE: g.evidence,
            P.INNOVATION: g.innovation, P.LEVEL: g.level, P.TREND: g.trend, P.GAIN: g.gain,
            P.MASS: g.mass, P.SHIFTS: g.shift, P.SPREAD: g.spread, P.OFFSET: g.offset,
            P.INFLATION: g.inflation, P.N_SEEN: g.count, P.RATES_OF_TAILS: tails.rates,
            P.FREEDOMS: tails.freedoms, P.TAIL_SCALE: tails.log_scale,
            P.TAIL_EVIDENCE: tails.evidence, P.NOISE_EVIDENCE: g.noise.evidence,
            P.NOISE_SHARES: g.noise.shares,
        }  # fmt: skip
        own = g._modules, g.learners._modules, g.noise._modules
        bound.watch((g, tails, g.noise), *own, moved=fields.values(), others=plans)
        bound.usable = all(
            t.is_cpu and t.is_contiguous() and t.dtype == torch.float64 for t in fields.values()
        )
        row = bound.row = np.zeros(P.FIELDS_OF_MIXTURE, np.int64)
        for field, tensor in fields.items():
            row[field] = tensor.data_ptr()
        row[P.MODELS], row[P.IN], row[P.OUT] = g.batch_shape.numel(), g.in_features, g.out_features
        row[P.N_EXPERTS], row[P.N_SHARES] = g.evidence.shape[-1], g.mass.shape[-1]
        row[P.N_TAILS], row[P.AT_ZERO] = len(tails.rates), bound.own(at_zero.numpy().copy())
        bound.all = np.ones(row[P.MODELS], np.bool_)
        return bound


def _plan(learner: Any) -> Plan | None:
    """What compiled loops know of a learner; None: nothing."""
    engine = getattr(learner, "engine", None)
    return engine.of(learner) if isinstance(engine, CompiledEngine) else None
