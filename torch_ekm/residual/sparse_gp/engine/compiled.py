"""The engine of compiled loops."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from ...._arrays import is_plain
from ...._warnings import warn
from ....exceptions import SpeedWarning
from ....typing import Tensor
from ...report import MomentsWithJacobians, UpdateReport
from ...running_scale import SETTLED, RunningScale
from ..hyperparameters import PARTS, LearnHyperparameters
from ..part import Host
from .binding import Bound, Engine, Plan
from .loading import load_loops

_LEFT = "{} learns by torch, which takes several times as long as compiled loops: {}"


class CompiledEngine(Engine):
    """Updates and queries of one sample per model by compiled loops, on the learner's own memory.

    Torch does the work without numba, on another device, in float32, where a gradient is to be carried,
    inside of a transformation or of torch.compile, and with kernels and parts that the loops do not know: of
    what a user could change a SpeedWarning says so, once.
    """

    def __init__(self) -> None:
        self._plan: Plan | None = None
        self._told = False

    # -- calls ----------------------------------------------------------------------------------

    def ask(
        self, gp: Host, x: Tensor, *, variance: bool = False, slopes: bool = False, noisy: bool = False
    ) -> MomentsWithJacobians | None:
        """One query per model, what is not wanted being empty; None: torch must do it."""
        plan = self.plan(gp, x)
        if plan is None:
            return None
        x, new = x.contiguous(), x.new_empty
        mean, v = new(plan.one), new(plan.one if variance else 0)
        J, dv = new(plan.two if slopes else 0), new(plan.two if slopes and variance else 0)
        load_loops().query_fleet(plan.row, noisy, *(t.data_ptr() for t in (x, mean, v, J, dv)))
        return MomentsWithJacobians(mean, v, J, dv)

    def learn(self, gp: Host, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport | None:
        """All that an update does; None: not one good sample for each model, or torch must do it."""
        plan = self.plan(gp, x)
        if plan is None or not is_plain_one(y, plan.one) or plan.is_rough(gp):
            return None
        x, y, on = x.contiguous(), y.contiguous(), on_array(plan, mask)
        figures, event = np.zeros((4, len(on))), np.zeros(len(on), np.int64)
        if mask is not None:
            figures[2] = 1.0
        at = x.data_ptr(), y.data_ptr()
        alarm = load_loops().update_fleet(plan.row, gp.n_samples, on, *at, figures, event)
        if alarm < 0:
            return None
        plan.act(gp, bool(alarm))
        found = (torch.from_numpy(each.reshape(plan.shape)) for each in (event, *figures[:3]))
        return UpdateReport(*found)

    def wanders(self, gp: Host) -> bool:
        """Whether :meth:`rebuild` does what ProcessNoise does before it."""
        plan = self._free(gp)
        return plan is not None and plan.share > 0.0

    def rebuild(self, gp: Host) -> bool:
        """The caches from the natural form; False: torch must do it."""
        plan = self._free(gp)
        if plan is not None:
            load_loops().rebuild_fleet(plan.row, plan.share)
        return plan is not None

    def descend(self, gp: Host, learning: LearnHyperparameters, n: int, end: float) -> bool:
        """A step on the loss, after n samples, up to this share of what it predicts; False: torch must do it.

        Its parts are the same, and so is their sum, whenever they come.
        """
        plan = self._free(gp)
        if plan is None:
            return False
        loops, step = load_loops(), (n, learning.since)
        begin = plan.begun[1]
        if plan.begun[0] != step:
            begin, leads = 0.0, learning.start(gp)
            loops.embed_fleet(plan.past)
            if leads:
                loops.rebuild_fleet(plan.past, 0.0)
        for until in PARTS:
            if begin < until <= end:
                loops.gather_fleet(plan.past, n, learning.since[0], gp.recent.n_taken, begin, until)
                begin = until
        if end == PARTS[-1]:
            loops.step_fleet(plan.past)
            gp.recent.n_taken += 1
        plan.begun = step, end
        return True

    def pairs(self, gp: Host) -> list[tuple[Tensor, Tensor]]:
        """See LearnHyperparameters; empty: torch must find them."""
        plan = self._free(gp)
        return [] if plan is None else plan.pairs

    def pool(self, gp: Host, n: int, size: int) -> bool:
        """The last ``size`` of n samples into the units, see ``Units.pool``; False: torch must do it."""
        if self._free(gp) is None:
            return False
        recent, models = gp.recent, gp.batch_shape.numel()
        for scale, values in ((gp.units.input, recent.x), (gp.units.output, recent.y)):
            sizes = models, n - size, size, recent.capacity, values.shape[-1], float(scale.memory)
            pooled = scale.shifted, scale.weight, scale.centre, scale.spread, scale.large
            load_loops().pool_columns(*sizes, *(t.data_ptr() for t in (values, recent.on, *pooled)))
        return True

    def settle(self, gp: Host) -> list[tuple[Tensor, Tensor] | None] | None:
        """Changes of the units of x and y, see ``RunningScale.settle``; None: torch must find them."""
        return None if self._free(gp) is None else [_settled(gp.units.input), _settled(gp.units.output)]

    def _free(self, gp: Host) -> Plan | None:
        return None if torch.compiler.is_compiling() else self.of(gp)

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
            with gp.lock:  # of two threads one binds, between two updates
                if self._plan is None or not self._plan.is_current():
                    self._plan = Plan(gp)
                plan = self._plan
        if not plan.usable:
            if not self._told and gp.device.type == "cpu":
                self._told = True
                warn(_LEFT.format(type(gp).__name__, plan.reason), SpeedWarning)
            return None
        return plan if plan.follows(gp.lock) else None


def _settled(scale: RunningScale) -> tuple[Tensor, Tensor] | None:
    *shape, columns = scale.scale.shape
    change, models = np.empty((2, scale.scale.numel())), math.prod(shape)
    found = scale.weight, scale.centre, scale.spread, scale.least, scale.scale, scale.shift
    if not load_loops().settle_columns(models, columns, SETTLED, change, *(t.data_ptr() for t in found)):
        return None
    offset, ratio = torch.from_numpy(change).view(2, *scale.scale.shape)
    return offset, ratio


def is_plain_one(x: Any, shape: tuple[int, ...]) -> bool:
    """Whether x is an ordinary tensor of that shape, of which torch keeps no record."""
    if not is_plain(x) or x.shape != shape:
        return False
    # operations of torch are being recorded, in this thread: torch has no public way to ask
    return not torch._C._len_torch_dispatch_stack() and not torch.jit.is_tracing()


def on_array(plan: Bound, mask: Tensor | None) -> np.ndarray:
    """Models that have a sample."""
    return plan.all if mask is None else np.ascontiguousarray(mask.numpy().reshape(-1))
