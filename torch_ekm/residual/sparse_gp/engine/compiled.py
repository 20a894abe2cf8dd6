"""The engine of compiled loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from ...._arrays import is_plain
from ...._warnings import warn
from ....exceptions import SpeedWarning
from ....typing import Tensor
from ...report import MomentsWithJacobians, UpdateReport
from .. import plan as P
from ..part import Host, Sample
from .binding import Bound, Plan
from .loading import load_loops
from .recursion import Absorbed
from .reference import ReferenceEngine

_LEFT = "{} learns by torch, which takes several times as long as compiled loops: {}"


class CompiledEngine(ReferenceEngine):
    """Updates and queries of one sample per model by compiled loops, on the learner's own memory.

    Torch does the work without numba, on another device, in float32, where a gradient is to be carried,
    inside of a transformation or of torch.compile, and with kernels and parts that the loops do not know: of
    what a user could change a SpeedWarning says so, once.
    """

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self._told = False

    def __deepcopy__(self, memo: dict) -> CompiledEngine:
        return CompiledEngine()

    def __reduce__(self) -> tuple[Any, ...]:
        return CompiledEngine, ()

    # -- queries --------------------------------------------------------------------------------

    def mean(self, gp: Host, x: Tensor) -> Tensor:
        found = self._ask(gp, x)
        return super().mean(gp, x) if found is None else found.mean

    def moments(self, gp: Host, x: Tensor) -> tuple[Tensor, Tensor]:
        found = self._ask(gp, x, variance=True)
        return super().moments(gp, x) if found is None else found[:2]

    def observed(self, gp: Host, x: Tensor) -> tuple[Tensor, Tensor]:
        found = self._ask(gp, x, variance=True, noisy=True)
        return super().observed(gp, x) if found is None else found[:2]

    def linearize(self, gp: Host, x: Tensor) -> tuple[Tensor, Tensor]:
        found = self._ask(gp, x, slopes=True)
        return super().linearize(gp, x) if found is None else (found.mean, found.mean_jacobian)

    def jacobians(self, gp: Host, x: Tensor) -> MomentsWithJacobians:
        found = self._ask(gp, x, variance=True, slopes=True)
        return super().jacobians(gp, x) if found is None else found

    def _ask(
        self, gp: Host, x: Tensor, *, variance: bool = False, slopes: bool = False, noisy: bool = False
    ) -> MomentsWithJacobians | None:
        """One query per model, what is not wanted being empty; None: torch must do it."""
        plan = self.plan(gp, x)
        if plan is None:
            return None
        x, new = x.contiguous(), x.new_empty
        mean, v = new(plan.one), new(plan.one if variance else 0)
        J, dv = new(plan.two if slopes else 0), new(plan.two if slopes and variance else 0)
        loops: Any = load_loops()
        addresses = (t.data_ptr() for t in (x, mean, v, J, dv))
        loops.query_fleet(plan.row, noisy, *addresses)
        return MomentsWithJacobians(mean, v, J, dv)

    # -- updates --------------------------------------------------------------------------------

    @torch.no_grad()
    def learn(self, gp: Host, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport | None:
        plan = self.plan(gp, x)
        if plan is None or not is_plain_one(y, plan.one):
            return None
        x, y = x.contiguous(), y.contiguous()
        loops: Any = load_loops()
        if not loops.are_finite(plan.row, x.data_ptr(), y.data_ptr()):
            return None
        turn = self.begin(gp, x, y, mask)
        *found, alarm = self._update(plan, turn, x, y, mask)
        self.finish(gp, x, y, mask, alarm, *found)
        return as_absorbed(plan, *found).report

    def absorb(self, gp: Host, x: Tensor, y: Tensor, on: Tensor | None) -> Absorbed:
        plan = self.plan(gp, x)
        if plan is None or not is_plain_one(y, plan.one):
            return super().absorb(gp, x, y, on)
        x, y, turn = x.contiguous(), y.contiguous(), (P.LEARN, -1, -1, -1, -1, 0)
        return as_absorbed(plan, *self._update(plan, turn, x, y, None if on is None else on > 0)[:3])

    def _update(
        self, plan: Plan, turn: tuple[int, ...], x: Tensor, y: Tensor, mask: Tensor | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        figures, event = np.zeros((4, len(plan.all))), np.zeros(len(plan.all), np.int64)
        if mask is not None:
            figures[2] = 1.0
        errors = np.zeros((len(plan.all), plan.one[-1]))
        loops: Any = load_loops()
        alarm = loops.update_fleet(
            plan.row, np.array(turn), on_array(plan, mask), x.data_ptr(), y.data_ptr(), figures, event, errors
        )
        return figures, event, errors, alarm

    def begin(self, gp: Host, x: Tensor, y: Tensor, mask: Tensor | None) -> tuple[int, ...]:
        """What the parts do before a sample is learned, and the places to which loops write it."""
        plan, n = self._plan, gp.n_samples
        assert plan is not None
        block = window = past = -1
        if plan.units is not None:
            if plan.units.acts_before(n, gp):
                plan.units.before_update(gp, x, y, None if mask is None else mask.to(x.dtype))
                plan.follow()
            else:
                block = plan.units.place(n, gp)
        if plan.learning is not None:
            window, past = plan.learning.places(n, gp)
        return P.NOTE, block, n % plan.ring, window, past, n

    def finish(
        self, gp: Host, x: Tensor, y: Tensor, mask: Tensor | None, alarm: bool, *found: np.ndarray
    ) -> None:
        """What the parts do after it, given what loops found of it."""
        plan = self._plan
        assert plan is not None
        if alarm:
            assert plan.changes is not None
            on = None if mask is None else mask.to(x.dtype)
            plan.changes.act(gp)
            done = as_absorbed(plan, *found)
            sample = Sample(x, y, on, done.innovation, done.variance, done.report)
            for part in plan.others:
                part.after_update(gp, sample)  # type: ignore[operator]
            gp.pending.add_(1.0 if on is None else on)
        elif plan.learning is not None:
            if plan.past is not None:
                plan.past.count()
            plan.learning.act(gp)
        gp.count_sample()

    # -- what they work on ----------------------------------------------------------------------

    def plan(self, gp: Host, x: Tensor) -> Plan | None:
        """What loops know of the learner, where this call is one for them."""
        if torch.compiler.is_compiling() or not is_plain_one(x, (*gp.batch_shape, gp.in_features)):
            return None
        return self.of(gp)

    def of(self, gp: Host) -> Plan | None:
        """The same, for any call."""
        plan = self._plan
        if plan is None or not plan.is_current():
            if load_loops() is None:
                return None
            plan = self._plan = Plan(gp)
        if not plan.usable:
            if not self._told and gp.device.type == "cpu":
                self._told = True
                warn(_LEFT.format(type(gp).__name__, plan.reason), SpeedWarning)
            return None
        if torch.is_grad_enabled() and any(p.requires_grad for p in plan.parameters):
            return None
        plan.follow()
        return plan


def is_plain_one(x: Any, shape: tuple[int, ...]) -> bool:
    """Whether x is an ordinary tensor of that shape, of which torch keeps no record."""
    if not is_plain(x) or x.shape != shape:
        return False
    # operations of torch are being recorded: torch has no public way to ask
    return not is_in_torch_dispatch_mode() and not torch.jit.is_tracing()


def on_array(plan: Bound, mask: Tensor | None) -> np.ndarray:
    """Models that have a sample."""
    return plan.all if mask is None else np.ascontiguousarray(mask.numpy().reshape(-1))


def as_absorbed(plan: Plan, figures: np.ndarray, event: np.ndarray, errors: np.ndarray) -> Absorbed:
    """What loops found, as tensors."""
    novelty, nis, weight, variance = torch.from_numpy(figures.reshape(4, *plan.shape)).unbind()
    report = UpdateReport(torch.from_numpy(event.reshape(plan.shape)), novelty, nis, weight)
    return Absorbed(report, torch.from_numpy(errors.reshape(plan.one)), variance)
