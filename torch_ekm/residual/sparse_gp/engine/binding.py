"""A learner's buffers as compiled loops see them, and which learners these know."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from itertools import chain, zip_longest
from operator import is_
from typing import Any

import numpy as np
import torch
from torch import nn

from ....typing import Tensor
from ...kernels.deep import DeepKernel
from ...kernels.kernel import Kernel
from ...kernels.linear import ActionLinearKernel, LinearKernel
from ...kernels.stationary import Matern32, SquaredExponential
from .. import plan as P
from ..forgetting import ForgettingFactor, ProcessNoise
from ..hyperparameters import LearnHyperparameters, is_logarithm
from ..monitor import CalibrateNoise, DetectChanges, RobustWeight
from ..part import Host, Part
from ..units import Standardize
from .loading import load_loops

_PARTS = (
    Standardize, RobustWeight, DetectChanges, CalibrateNoise, LearnHyperparameters, ForgettingFactor,
    ProcessNoise,
)  # fmt: skip
_KINDS = {SquaredExponential: 0, Matern32: 1}  # as numba_kernels has them


class Engine:
    """Knows memory by address, so a copy of it begins anew."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), ()


class Bound:
    """A module's memory as compiled loops see it, and whether it is still the module's."""

    usable = False
    all: np.ndarray  #: True for each model

    def __init__(self) -> None:
        self.row = np.zeros(P.FIELDS, np.int64)
        self.kept: list[Any] = []  # arrays of their own, which live as long as their addresses are used
        self._owners: list[dict[str, Any]] = []
        self._values: list[Any] = []
        self._moved: list[Tensor] = []

    def watch(
        self,
        modules: Iterable[nn.Module],
        *owners: dict[str, Any],
        moved: Iterable[Tensor] = (),
        others: Sequence[Bound] = (),
    ) -> None:
        """What these hold must stay the same objects, and ``moved`` at their addresses; as of ``others``."""
        own = [dicts for one in modules for dicts in (one._parameters, one._buffers)]
        theirs = (owner for other in others for owner in other._owners)
        self._owners = [one for one in (*own, *owners, *theirs) if one]
        self._values = list(chain.from_iterable(map(dict.values, self._owners)))
        self._moved = [*moved, *(t for other in others for t in other._moved)]  # by an assignment to .data
        self._addresses = [t.data_ptr() for t in self._moved]

    def is_current(self) -> bool:
        """Whether all are those that were bound."""
        held = chain.from_iterable(map(dict.values, self._owners))
        return (
            all(map(is_, held, self._values)) and list(map(Tensor.data_ptr, self._moved)) == self._addresses
        )

    def own(self, array: np.ndarray) -> int:
        """The address of an array that lives as long as this."""
        self.kept.append(array)
        return array.ctypes.data


class Plan(Bound):
    """What compiled loops know of a sparse GP, or why they cannot do its work.

    The arrays are made at the first call, and again whenever a buffer is another one: the learner was moved,
    or loaded with other tensors.
    """

    def __init__(self, gp: Host) -> None:
        super().__init__()
        self.units, self.changes = gp.part(Standardize), gp.part(DetectChanges)
        self.learning = gp.part(LearnHyperparameters)
        changing = [one for one in gp._parts if type(one).on_rebuild is not Part.on_rebuild]
        last = changing[-1] if changing else None
        #: of ProcessNoise, where nothing else changes the natural form after it
        self.share = last.share if isinstance(last, ProcessNoise) else 0.0
        self.begun: tuple[Any, float] = None, 0.0  # a step in parts: which one, and how far
        self.shape = tuple(gp.batch_shape)
        self.one, self.two = (*self.shape, gp.out_features), (*self.shape, gp.out_features, gp.in_features)
        self.all = np.ones(math.prod(self.shape), np.bool_)
        fields, learned = self._fields(gp), () if self.learning is None else self.learning.buffers()
        self.parameters = tuple(gp.kernel.hyperparameters().values())
        #: see LearnHyperparameters
        self.pairs = []
        if self.learning is not None:
            theta = (*self.parameters, gp.log_noise_variance)
            self.pairs = list(zip(self.learning.ahead().values(), theta, strict=True))
        tensors = [value for value in fields.values() if isinstance(value, Tensor)]
        tensors += [*gp.units.buffers(), *learned, *self.parameters]
        used = set(map(id, tensors))
        owners = (one for one in gp.modules() if not used.isdisjoint(map(id, one.buffers(recurse=False))))
        own = *owners, *(one for one in gp.kernel.modules() if one._parameters)
        handed_out = gp.posterior.buffers()  # whoever sends one to a process has torch move its memory
        self.watch(own, gp._modules, moved=(*self.parameters, gp.log_noise_variance, *handed_out))
        self.reason = _reason(gp, tensors)
        self.usable = not self.reason
        if not self.usable:
            return
        self.row = self._row(gp.kernel, fields)
        self.row[P.ROOM] = self.own(
            np.empty((len(self.all), self.row[[P.VALUES, P.WIDTH]].sum() + 2 * self.row[P.SLOTS] + 1))
        )
        self._basis, self._marks = gp.posterior.basis, [-1]
        if self.learning is not None:
            self.past = self._of_learning(gp, self.learning, fields)

    def _row(self, kernel: Kernel, fields: dict[int, Any]) -> np.ndarray:
        """Sizes and addresses of a state with that kernel."""
        row = np.zeros(P.FIELDS, np.int64)
        for field, value in {**fields, **(_known(kernel) or {})}.items():
            row[field] = value.data_ptr() if isinstance(value, Tensor) else value
        layers = []
        if isinstance(kernel, DeepKernel):
            for weight, bias in zip_longest(kernel.weights, kernel.biases):
                addresses = weight.data_ptr(), 0 if bias is None else bias.data_ptr()
                layers.append([*weight.shape[-2:], *addresses, self.own(np.empty(weight.numel()))])
        row[P.LAYERS], row[P.NETWORK] = len(layers), self.own(np.array(layers, np.int64))
        row[P.WIDTH] = row[P.IN] + (layers[-1][1] if layers else 0)
        row[P.VALUES] = row[P.IN] + sum(layer[1] for layer in layers)
        for field, width in ((P.EMBEDDED, P.WIDTH), (P.LAYERED, P.VALUES)):
            row[field] = self.own(np.empty((len(self.all), row[P.SLOTS], row[width])))
        return row

    def _fields(self, gp: Host) -> dict[int, Any]:
        posterior, recent, x, y = gp.posterior, gp.recent, gp.units.input, gp.units.output
        robust, calibrated = gp.part(RobustWeight), gp.part(CalibrateNoise)
        threshold = 0.0 if robust is None else robust.threshold**2
        fields: dict[int, Any] = {
            P.MODELS: len(self.all), P.SLOTS: posterior.capacity + 1,
            P.IN: gp.in_features, P.OUT: gp.out_features,
            P.FIGURES: self.own(np.array([posterior.novelty_threshold, posterior.jitter, threshold])),
            P.BASIS: posterior.basis, P.ACTIVE: posterior.active, P.COUNT: posterior.count,
            P.SLOT: posterior.slot, P.MOMENTS: posterior.moments, P.VECTORS: posterior.vectors,
            P.PENDING: gp.pending, P.LARGEST: gp.largest, P.LOG_NOISE: gp.log_noise_variance,
            P.SHIFT: x.shift, P.SCALE: x.scale, P.SHIFT_Y: y.shift, P.SCALE_Y: y.scale, P.REACH: x.reach,
            P.RECENT_X: recent.x, P.RECENT_Y: recent.y, P.RECENT_ON: recent.on, P.RECENT: recent.weight,
            P.RECENT_SIZE: recent.capacity,
        }  # fmt: skip
        if robust is not None:
            fields[P.DISTRUSTED] = robust.level
        if calibrated is not None:
            fields[P.FACTOR] = calibrated.log_factor
        if self.changes is not None:
            level, misled = self.changes.level, self.changes.misled.level
            fields |= {P.CHANGED: level, P.LEVELS: self.changes.levels, P.MISLED: misled}
        return fields

    def _of_learning(self, gp: Host, learning: LearnHyperparameters, fields: dict[int, Any]) -> np.ndarray:
        """Of the past state, of which the loss is, with the parameters that steps lead to."""
        loss, past = learning.loss, learning.loss.state
        figures = np.array([learning.rate, (loss.robust or 0.0) ** 2, loss.forgetting_factor])
        row = self._row(learning.kernel, {
            **fields, P.BASIS: past.basis, P.ACTIVE: past.active, P.MOMENTS: past.moments,
            P.VECTORS: past.vectors, P.LOG_NOISE: learning.log_noise, P.N_STEPS: learning.n_steps,
            P.RATES: self.own(figures),
        })  # fmt: skip
        d, models = gp.in_features, len(self.all)
        states = row[[P.LOG_LENGTHSCALE, P.LOG_ACTION, P.LOG_VARIANCE]].tolist()
        places, at, rows = dict(zip(states, (0, d - int(row[P.ACTIONS]), d), strict=True)), d + 1, []
        if isinstance(learning.kernel, DeepKernel):
            pairs = zip_longest(learning.kernel.weights, learning.kernel.biases)
            for p in filter(lambda p: p is not None, chain.from_iterable(pairs)):
                places[p.data_ptr()], at = at, at + p.numel() // models
        places[learning.log_noise.data_ptr()] = at
        for i, (name, p) in enumerate(learning.ahead().items()):
            size, noise = p.numel() // models, name == "log_noise"
            moments = (learning.adam.get_buffer(f"{order}_{i}").data_ptr() for order in ("first", "second"))
            rows.append([p.data_ptr(), *moments, size, places[p.data_ptr()], is_logarithm(name) + noise])
        M, m, n = row[P.SLOTS], gp.out_features, at + gp.out_features
        row[P.LEARNING] = self.own(np.array([learning.window, learning.replayed(), len(rows), n]))
        row[P.PARAMETERS] = self.own(np.array(rows))
        row[P.SUMS] = self.own(np.empty((models, M * (2 * M + m + row[P.WIDTH]) + n + 3)))
        return row

    def is_rough(self, gp: Host) -> bool:
        """Whether a part changes the state before the present sample is learned."""
        return self.units is not None and self.units.is_rough(gp)

    def act(self, gp: Host, alarm: bool) -> None:
        """What is due after the notes of a sample."""
        if self.units is not None:
            self.units.act(gp)
        if alarm and self.changes is not None:
            self.changes.act(gp)
        if self.learning is not None:
            self.learning.act(gp)
        gp.count_sample()

    def follows(self, lock: AbstractContextManager) -> bool:
        """Embed the basis again where torch changed it, or the kernel: loops leave no mark on a tensor.

        ``lock``: of whoever learns. False: a gradient is to be carried, which loops cannot.
        """
        if torch.is_grad_enabled() and any(p.requires_grad for p in self.parameters):
            return False
        if self._found() != self._marks:
            with lock:
                marks = self._found()
                load_loops().embed_fleet(self.row)
                self._marks = marks
        return True

    def _found(self) -> list[int]:
        return [t._version for t in (self._basis, *self.parameters)]


def _reason(gp: Host, tensors: list[Tensor]) -> str:
    """Why compiled loops do not know this learner; empty: they do."""
    if _known(gp.kernel) is None:
        return f"they do not know its kernel, {type(gp.kernel).__name__}"
    hooks = [getattr(Part, name) for name in ("before_update", "weigh", "after_update", "act", "noise")]
    for part in gp.parts:
        own = [getattr(type(part), hook.__name__) for hook in hooks]
        if type(part) not in _PARTS and own != hooks:
            return f"they do not know its part, {type(part).__name__}"
    if gp.dtype != torch.float64:
        return f"they compute in float64, and its dtype is {gp.dtype}"
    if not all(t.is_cpu and t.is_contiguous() for t in tensors):
        return "a buffer of it is not contiguous, or not on the CPU"
    # these have no version
    return "it was made in inference mode" if any(t.is_inference() for t in tensors) else ""


def _known(kernel: Kernel) -> dict[int, Any] | None:
    """Fields of a kernel that the loops know; None: they do not. A subclass may compute something else."""
    if type(kernel) is LinearKernel:  # action-linear without a state
        slopes, log_variance = kernel.log_slope_variance, kernel.log_variance
        return {P.KIND: 0, P.ACTIONS: slopes.shape[-1], P.LOG_ACTION: slopes, P.LOG_VARIANCE: log_variance}
    inner = {ActionLinearKernel: "state_kernel", DeepKernel: "base"}.get(type(kernel))
    state: Any = kernel if inner is None else getattr(kernel, inner)
    if type(state) not in _KINDS:
        return None
    own = {P.LOG_LENGTHSCALE: state.log_lengthscale, P.LOG_VARIANCE: state.log_variance}
    fields = {P.KIND: _KINDS[type(state)], **own}
    if isinstance(kernel, ActionLinearKernel):
        fields |= {P.ACTIONS: kernel.action_features, P.LOG_ACTION: kernel.log_action_variance}
    return fields
