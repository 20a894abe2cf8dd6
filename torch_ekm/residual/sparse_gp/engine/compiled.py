"""The engine of compiled loops: which work they can do, and the learner's buffers as they see them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from ...._arrays import is_plain
from ....typing import Array, Tensor
from ...base import FARTHEST
from ...kernels.action_linear import ActionLinearKernel
from ...kernels.deep import DeepKernel
from ...kernels.kernel import Kernel
from ...kernels.linear import LinearKernel
from ...kernels.stationary import Matern32, Matern52, SquaredExponential
from ...report import MomentsWithJacobians, UpdateReport
from ..monitor import RobustWeight
from ..part import Host
from .embedding import Embedding
from .loading import load_loops
from .recursion import Absorbed
from .reference import ReferenceEngine


class CompiledEngine(ReferenceEngine):
    """A learner's buffers as arrays that share their memory, and the compiled calls on them.

    The arrays are made at the first call, and again whenever a buffer is another one: the learner was moved,
    or loaded with other tensors. Torch does the work without numba, on another device, in float32, where a
    gradient is to be carried, inside of a transformation or of torch.compile, and with parts that weigh
    samples in ways that are not known here.
    """

    def __init__(self) -> None:
        self._kernel: Kernel | None = None
        self._sources: list[tuple[dict, str, Tensor, int]] = []
        self._network: Embedding | None = None
        self._usable = False
        self._marks: list[int] = []  # versions of all tensors: torch changed something where they differ
        self._at: object = object()  # another one after each change
        # the last one: when, query, whether with variance and with slopes, results
        self._answer: tuple[object, bytes, bool, bool, tuple[Array, ...]] = None, b"", False, False, ()

    def __deepcopy__(self, memo: dict) -> CompiledEngine:
        return CompiledEngine()

    def __reduce__(self) -> tuple[Any, ...]:
        return CompiledEngine, ()

    # -- calls ----------------------------------------------------------------------------------

    def mean(self, gp: Host, x: Tensor) -> Tensor:
        found = self._ask(gp, x)
        return super().mean(gp, x) if found is None else _tensor(found[0])

    def moments(self, gp: Host, x: Tensor) -> tuple[Tensor, Tensor]:
        found = self._ask(gp, x, variance=True)
        return super().moments(gp, x) if found is None else (_tensor(found[0]), _tensor(found[1]))

    def linearize(self, gp: Host, x: Tensor) -> tuple[Tensor, Tensor]:
        found = self._ask(gp, x, slopes=True)
        return super().linearize(gp, x) if found is None else (_tensor(found[0]), _tensor(found[2]))

    def jacobians(self, gp: Host, x: Tensor) -> MomentsWithJacobians:
        found = self._ask(gp, x, variance=True, slopes=True)
        return super().jacobians(gp, x) if found is None else MomentsWithJacobians(*map(_tensor, found))

    def accepts(self, gp: Host, x: Tensor, y: Tensor) -> bool:
        if not self._takes(gp, x) or not is_plain_one(y, (*self._batch, self._m)):
            return False
        x_, y_ = x.numpy().reshape(-1), y.numpy().reshape(-1)
        with np.errstate(over="ignore"):  # a number without a square is refused, not warned of
            return math.isfinite(x_.dot(x_) + y_.dot(y_))

    def absorb(self, gp: Host, x: Tensor, y: Tensor, on: Tensor | None) -> Absorbed:
        if not self._takes(gp, x) or not is_plain_one(y, (*self._batch, self._m)):
            return super().absorb(gp, x, y, on)
        posterior, flags, n_models, m = self._posterior, self._flags, self._n_models, self._m
        k, prior, mask = self._none2, self._none1, self._all
        if self._given:
            x, y = gp.units.inputs(x), gp.units.targets(y)
            with torch.no_grad():
                k = gp.kernel.vector(x, posterior.basis).reshape(n_models, -1).numpy()
                prior = np.ascontiguousarray(gp.kernel.diagonal(x).reshape(-1).numpy())
        event, figures, errors = np.zeros(n_models, np.int64), np.zeros((4, n_models)), np.zeros(n_models * m)
        if on is not None:
            mask = (on > 0).reshape(-1).numpy()
            figures[2] = 1.0
        inputs = x.numpy().reshape(-1)
        if self._network is not None:
            z, inputs, _ = self._network.of(x, self._units_x, slopes=False)
            self._network.keep(z, mask)
        self._at = object()
        self._absorb(
            flags, mask, inputs, y.numpy().reshape(-1), k, prior, *self._state, *self._hyper,
            self._noise, *self._units, self._robust, self._levels,
            posterior.novelty_threshold, posterior.jitter, event, figures, errors,
        )  # fmt: skip
        self._at = object()  # what another thread asked meanwhile is of neither state
        batch = self._batch
        novelty, nis, weight, variance = torch.from_numpy(figures.reshape(4, *batch)).unbind()
        report = UpdateReport(torch.from_numpy(event.reshape(batch)), novelty, nis, weight)
        return Absorbed(report, torch.from_numpy(errors.reshape(*batch, m)), variance)

    def _ask(
        self, gp: Host, x: Tensor, *, variance: bool = False, slopes: bool = False
    ) -> tuple[Array, ...] | None:
        """One query per model, what is not wanted perhaps being empty; None if torch must do it.

        The last answer is kept: a learner is often asked for several things at the same x.
        """
        if not self._takes(gp, x) or self._given:
            return None
        at, query = self._at, x.numpy().tobytes()
        then, of, had_variance, had_slopes, found = self._answer
        if then is at and of == query and had_variance >= variance and had_slopes >= slopes:
            return found
        n, d = self._n_models * self._m, self._width
        mean, v = np.empty(n), np.empty(n if variance else 0)
        J, dv = np.empty(n * d if slopes else 0), np.empty(n * d if slopes and variance else 0)
        basis, active, _, _, moments, vectors = self._state
        network, inputs, by = self._network, x.numpy().reshape(-1), self._none1
        if network is not None:
            _, inputs, by = network.of(x, self._units_x, slopes)
        self._query(
            self._flags, inputs, basis, active, moments, vectors, *self._hyper, *self._units,
            FARTHEST * self._largest, variance, slopes, mean, v, J, dv,
        )  # fmt: skip
        if network is not None and slopes:
            J, dv = (network.by_x(a, by, self._units_x[1]) if a.size else a for a in (J, dv))
        one, two = (*self._batch, self._m), (*self._batch, self._m, self._d)
        shapes = zip((mean, v, J, dv), (one, one, two, two), strict=True)
        found = tuple(a.reshape(shape) if a.size else a for a, shape in shapes)
        self._answer = at, query, variance, slopes, found
        return found

    # -- what they work on ----------------------------------------------------------------------

    def _takes(self, gp: Host, x: Tensor) -> bool:
        """Whether this call is one for compiled loops; prepares the arrays."""
        if torch.compiler.is_compiling() or not is_plain_one(x, (*gp.batch_shape, gp.in_features)):
            return False
        if load_loops() is None:
            return False
        if gp.kernel is not self._kernel or not self._is_current():
            self._bind(gp)
        if not self._usable:
            return False
        marks = [source[2]._version for source in self._sources]
        if marks != self._marks:
            self._at = object()
            if self._network is not None:
                self._network.follow()
            self._marks = marks
        return not (torch.is_grad_enabled() and any(p.requires_grad for p in self._parameters))

    def _is_current(self) -> bool:
        """Whether all tensors are those that were bound, at the same place in memory."""
        for owner, name, tensor, pointer in self._sources:
            if owner.get(name) is not tensor or tensor.data_ptr() != pointer:
                return False
        return True

    def _bind(self, gp: Host) -> None:
        self._kernel, self._posterior, self._usable = gp.kernel, gp.posterior, False
        self._network = None
        self._batch, self._d, self._m = tuple(gp.batch_shape), gp.in_features, gp.out_features
        self._n_models = n = gp.batch_shape.numel()
        posterior = gp.posterior
        state = (
            posterior.basis, posterior.active, posterior.count, posterior.slot, posterior.moments,
            posterior.vectors,
        )  # fmt: skip
        own, units = _known(gp.kernel, self._batch), gp.units.affine()
        self._parameters = tuple(own[1] if own is not None else gp.kernel.parameters())
        robust = [part for part in gp.weighing if type(part) is RobustWeight]
        levels = [part.level for part in robust]
        tensors = (*state, gp.log_noise_variance, gp.largest, *self._parameters, *units, *levels)
        self._sources = sources_of(gp, tensors)
        on_host = all(t.is_cpu and t.is_contiguous() for t in tensors) and gp.dtype == torch.float64
        plain = not any(t.is_inference() for t in tensors)  # these have no version
        if not on_host or len(robust) < len(gp.weighing) or not plain:
            return
        self._marks, loops = [], load_loops()
        assert loops is not None  # else this is not called
        self._given = own is None
        kind, n_actions = (_GIVEN, 0) if own is None else own[0]
        self._flags = np.array([kind, n_actions])
        self._robust = np.array([part.threshold**2 for part in robust])
        self._levels = levels[0].numpy().reshape(n) if levels else np.empty(0)
        self._none1, self._none2, self._all = np.empty(0), np.empty((0, 0)), np.ones(n, np.bool_)
        self._state = tuple(t.numpy().reshape(n, *t.shape[len(self._batch) :]) for t in state)
        self._width = self._d
        self._noise = gp.log_noise_variance.detach().numpy().reshape(n, -1)
        self._hyper: tuple[Array, ...] = np.zeros((1, 0)), np.zeros(1), np.zeros((1, 0))
        self._units: tuple[Array, ...] = (
            np.zeros((1, self._d)), np.ones((1, self._d)), np.zeros((1, self._m)), np.ones((1, self._m)),
            np.full(self._d, np.inf),
        )  # fmt: skip
        self._largest = gp.largest.numpy().reshape(n, self._m)
        if own is not None:
            lengthscale, variance, *others = (p.detach().numpy() for p in self._parameters)
            rows = variance.reshape(-1)
            action = others[0] if n_actions else np.zeros((len(rows), 0))
            self._hyper = lengthscale.reshape(len(rows), -1), rows, action.reshape(len(rows), -1)
            if units:
                assert gp.units.reach is not None
                self._units = *(t.numpy().reshape(n, -1) for t in units), gp.units.reach.numpy()
            if isinstance(gp.kernel, DeepKernel):
                self._network = Embedding(loops, gp.kernel, posterior)
                self._width = width = self._network.width
                self._units_x = self._units[:2]
                plain = np.zeros((len(self._units[2]), width))
                self._units = plain, plain + 1.0, *self._units[2:4], np.full(width, np.inf)
                self._hyper = np.zeros((len(rows), width)), rows, action.reshape(len(rows), 0)
                self._state = self._network.basis, *self._state[1:]
        self._absorb: Callable = loops.absorb_fleet
        self._query: Callable = loops.query_fleet
        self._usable = True


def _tensor(kept: Array) -> Tensor:
    """A copy: what is kept must not change with what was given away."""
    return torch.from_numpy(kept.copy())


def is_plain_one(x: Any, shape: tuple[int, ...]) -> bool:
    """Whether x is an ordinary tensor of that shape, of which torch keeps no record."""
    if not is_plain(x) or x.shape != shape or not x.is_contiguous():
        return False
    # operations of torch are being recorded: torch has no public way to ask
    return not is_in_torch_dispatch_mode() and not torch.jit.is_tracing()


# as numba_kernels has them
_KINDS, _GIVEN = {SquaredExponential: 0, Matern32: 1, Matern52: 2}, 3


def _known(kernel: Kernel, batch: tuple[int, ...]) -> tuple[tuple[int, int], list[Tensor]] | None:
    """(kind, width of the action) and the parameters of a kernel that the loops know themselves."""
    if type(kernel) is LinearKernel:  # action-linear without a state
        slopes, variance = kernel.log_slope_variance, kernel.log_variance
        alike = slopes.shape[:-1] == variance.shape and variance.shape in ((), batch)
        return ((0, slopes.shape[-1]), [slopes[..., :0], variance, slopes]) if alike else None
    inner = {ActionLinearKernel: "state_kernel", DeepKernel: "base"}.get(type(kernel))
    state = kernel if inner is None else getattr(kernel, inner)
    kind = _KINDS.get(type(state))  # a subclass may compute something else
    if kind is None:
        return None
    parameters: list[Tensor] = [state.log_lengthscale, state.log_variance]  # type: ignore[list-item]
    n_actions = 0
    if isinstance(kernel, ActionLinearKernel):
        parameters.append(kernel.log_action_variance)
        n_actions = kernel.action_features
    shapes = [tuple(p.shape[:-1]) for p in (parameters[0], *parameters[2:])]
    if isinstance(kernel, DeepKernel):
        parameters += [*kernel.weights, *kernel.biases]
        shapes += [tuple(w.shape[:-2]) for w in kernel.weights] + [tuple(b.shape[:-1]) for b in kernel.biases]
    variance = parameters[1]
    alike = all(shape == tuple(variance.shape) for shape in shapes) and variance.shape in ((), batch)
    return ((kind, n_actions), parameters) if alike else None


def sources_of(gp: nn.Module, tensors: tuple[Tensor, ...]) -> list[tuple[dict, str, Tensor, int]]:
    """Where in the learner each of these tensors is kept, and its place in memory."""
    wanted = {id(tensor) for tensor in tensors}
    found = []
    for module in gp.modules():
        for owner in (module._parameters, module._buffers):
            kept = ((name, t) for name, t in owner.items() if t is not None and id(t) in wanted)
            found += [(owner, name, t, t.data_ptr()) for name, t in kept]
    return found
