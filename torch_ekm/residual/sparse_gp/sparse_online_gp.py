from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import nn
from torch.distributions import Normal

from ..._checks import check_count
from ...typing import Float, Tensor
from ..base import joint_draws
from ..kernels.deep import DeepKernel
from ..kernels.kernel import Kernel, check_kernel, fleet_options, log_parameter
from ..kernels.stationary import Matern32, StationaryKernel
from ..printed import sparse_gp
from ..recent import Recent
from ..report import MomentsWithJacobians, UpdateReport
from ..running_scale import BLOCK, RunningScale, Units
from .engine.compiled import CompiledEngine
from .engine.recursion import absorb
from .forgetting import ProcessNoise
from .hyperparameters import LearnHyperparameters
from .monitor import CalibrateNoise, DetectChanges, RobustWeight
from .part import Host, Part, Sample, copy_parts
from .posterior import SparsePosterior
from .units import Standardize


class SparseOnlineGP(Host):
    """``g ~ GP(0, k)``, ``y = g(x) + noise``, on at most ``capacity`` basis vectors::

        mean(x) = alpha' k(X, x),   var(x) = k(x, x) + k(X, x)' C k(X, x)

    One sample costs O(b^2 + b m), a prediction O(b m) for the mean and O(b^2) for the variance
    (b basis vectors, m outputs). A sample with novelty ``gamma = k** - k'Qk`` above the threshold becomes
    a basis vector, another is projected onto the basis by KL divergence; beyond the capacity the vector
    with the lowest score is pruned, the same way (Csato & Opper, Neural Computation 14, 2002).

    The state is kept in natural form and the caches that predict are rebuilt from it by Cholesky every
    ``refresh_every`` samples: the textbook recursion, which never rebuilds, ends in NaN on smooth
    trajectories. The state is always float64; ``dtype`` is that of inputs and outputs: float32
    cannot hold K^-1 of a smooth kernel.

    The outputs share the basis and one noise-to-signal ratio in the gain; each has its own scale and
    its own observation noise.

    All else is a list of parts (:class:`Part`), each with its own few arguments::

        SparseOnlineGP(d, m, parts=[Standardize(), RobustWeight(3.0), LearnHyperparameters()])

    Of a kind one at most, called in the order of the list. Where order matters: ``LearnHyperparameters``
    stands last, and ``ForgettingFactor``, ``ProcessNoise`` and ``Standardize`` change the natural form one
    after the other at each rebuild.

    Args:
        capacity: largest number of basis vectors b.
        kernel: covariance function in the learner's (standardised) units; default Matern 3/2
            with lengthscale sqrt(in_features) and unit variance.
        noise_variance: s2 in the (standardised) output's squared units, one number or one per output.
        novelty_threshold: smallest ``gamma / k**`` of a new basis vector.
        parts: what it does apart from projecting samples; copied.
        standardize: whether it follows the stream's units, unless a part does; or how.
        refresh_every: samples after which parts may change the state, and the caches are rebuilt.
        refresh_offset: samples by which this comes later, for learners that are not to do it at the same one.
        options: see ResidualLearner.

    Attributes:
        engine: compiled loops for updates and queries of one sample per model, on the CPU in float64, where
            numba is installed (extra ``fast``); they agree with torch to rounding. None: torch alone.

    Raises:
        ParameterError: a parameter is outside its range, or parts do not go together.
    """

    starts = ("noise_variance",)

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        capacity: int = 100,
        kernel: Kernel | None = None,
        noise_variance: float | Tensor = 0.1,
        novelty_threshold: float = 1e-4,
        parts: Iterable[nn.Module] | None = None,
        standardize: bool | Standardize = True,
        refresh_every: int = 32,
        refresh_offset: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.capacity = check_count("capacity", capacity)
        self.refresh_every = check_count("refresh_every", refresh_every)
        self.refresh_offset = check_count("refresh_offset", refresh_offset, least=0) % self.refresh_every
        shape, double = self.batch_shape, {"dtype": torch.float64, "device": self.device}
        if kernel is None:
            kernel = Matern32(self.in_features, batch_shape=shape, **double)
        self.kernel = check_kernel(kernel, self.in_features, shape).to(**double)
        noise_shape = (*shape, self.out_features)
        self.log_noise_variance = log_parameter("noise_variance", noise_variance, noise_shape, **double)
        sizes = self.in_features, self.out_features, self.capacity
        fleet = {"batch_shape": shape, "device": self.device}
        self.posterior = SparsePosterior(*sizes, novelty_threshold=novelty_threshold, **fleet)
        # samples of each model since the caches were made
        self.pending = nn.Buffer(torch.zeros(shape, **double))
        self.engine: CompiledEngine | None = CompiledEngine()
        self.n_samples = 0  # on the host, so that the rhythm of rebuilds never asks the GPU
        self.units = Units(*(RunningScale(size, **fleet) for size in sizes[:2]))
        self.recent, self._parts = Recent(*sizes[:2], BLOCK, **fleet, dtype=torch.float64), ()
        own = default_parts() if parts is None else copy_parts(parts)
        if standardize and not any(isinstance(part, Standardize) for part in own):
            own[:0] = copy_parts([standardize if isinstance(standardize, Standardize) else Standardize()])
        for part in own:
            part.bind(self)
            self._parts += (part,)
        self.parts = nn.ModuleList(self._parts)

    # -- predictions ----------------------------------------------------------------------------

    def forward(self, x: Tensor) -> Tensor:
        """Posterior mean ``alpha' k(X, x)`` in the outputs' units, differentiable in x."""
        found = self._ask(x)
        return self._mean(self._cross(self._inputs(x))) if found is None else found.mean

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """N(mean, var), with the observation noise added on request."""
        mean, variance = self.moments(x, observation=observation)
        return Normal(mean, variance.sqrt(), validate_args=False)

    def moments(self, x: Tensor, *, observation: bool = False) -> tuple[Tensor, Tensor]:
        """Mean and variance ``k** + k'Ck``, with the observation noise on request."""
        found = self._ask(x, variance=True, noisy=observation)
        if found is not None:
            return found[:2]
        z = self._inputs(x)
        k = self._cross(z)
        column = k.unsqueeze(-1)
        kCk = (column.mT @ (self.posterior.covariance @ column)).squeeze(-1).squeeze(-1)
        variance = self._out((self.kernel.diagonal(z) + kCk).clamp_min(0.0).unsqueeze(-1), 2)
        return self._mean(k), variance + self.noise_variance.to(self.dtype) if observation else variance

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and its derivative, ``(alpha'k, alpha' dk/dx)``, in closed form."""
        found = self._ask(x, slopes=True)
        if found is not None:
            return found.mean, found.mean_jacobian
        z = self._inputs(x)
        # free slots need no mask here: their rows in alpha and C are 0
        k, dk = self.kernel.with_gradient(z, self.posterior.basis)
        alpha = self.posterior.alpha.mT
        mean = self._out((alpha @ k.unsqueeze(-1)).squeeze(-1), 1)
        return self.bounded_slope(mean, self._out_slope(alpha @ dk, 1, z))

    def slope_deviation(self, x: Tensor) -> Tensor:
        """Root of ``d2k(x, z)/dx dz + (dk/dx)' C dk/dx`` at ``z = x``, by column."""
        z = self._inputs(x)
        _, dk = self.kernel.with_gradient(z, self.posterior.basis)
        v = self.kernel.derivative_variance(z) + (dk * (self.posterior.covariance @ dk)).sum(-2)
        # where z is cut g is flat, but what is known of it does not grow
        return self._out_slope(v.clamp_min(0.0).sqrt().unsqueeze(-2), 1, torch.zeros_like(z))

    def unit_draws(self, x: Tensor, n: int, generator: torch.Generator | None) -> Tensor:
        """From the covariance ``K(x, x') + k' C k'`` of the queries."""
        z = self.units.input(x).reshape(-1, *self.batch_shape, self.in_features).movedim(0, -2)
        k = self.kernel(z, self.posterior.basis) * self.posterior.active.unsqueeze(-2)
        covariance = self.kernel(z, z) + k @ self.posterior.covariance @ k.mT
        draws = joint_draws(covariance, n, self.out_features, generator)
        return draws.reshape(n, *x.shape[:-1], self.out_features).to(self.dtype)

    def predict_with_jacobians(self, x: Float[Tensor, "*any in"]) -> MomentsWithJacobians:
        """Mean, latent variance and both derivatives, in closed form.

        ```
        d mean/dx = alpha' dk/dx,   d var/dx = dk(x,x)/dx + 2 (Ck)' dk/dx
        ```
        """
        found = self._ask(x, variance=True, slopes=True)
        if found is not None:
            return found
        z = self._inputs(x)
        k, dk = self.kernel.with_gradient(z, self.posterior.basis)
        column, alpha = k.unsqueeze(-1), self.posterior.alpha
        Ck = self.posterior.covariance @ column
        # alpha and Ck side by side share one pass over k and one over dk
        left = torch.cat([alpha.expand(*Ck.shape[:-1], alpha.shape[-1]), Ck], dim=-1).mT
        values, slopes = (left @ column).squeeze(-1), left @ dk
        v = (self.kernel.diagonal(z) + values[..., -1]).clamp_min(0.0).unsqueeze(-1)
        dv = self.kernel.diagonal_gradient(z).unsqueeze(-2) + 2.0 * slopes[..., -1:, :]
        jacobian = self._out_slope(slopes[..., :-1, :], 1, z)
        mean, jacobian = self.bounded_slope(self._out(values[..., :-1], 1), jacobian)
        return MomentsWithJacobians(mean, self._out(v, 2), jacobian, self._out_slope(dv, 2, z))

    def _ask(self, x: Tensor, **wanted: bool) -> MomentsWithJacobians | None:
        """What compiled loops say; None: torch must do it."""
        return None if self.engine is None else self.engine.ask(self, x, **wanted)

    def _inputs(self, x: Tensor) -> Tensor:
        return self.units.input(self.check_query(x))

    def _cross(self, z: Tensor) -> Tensor:
        """k(X, z) of the slots in use."""
        return self.kernel.vector(z, self.posterior.basis) * self.posterior.active

    def _mean(self, k: Tensor) -> Tensor:
        return self.bounded(self._out((k.unsqueeze(-2) @ self.posterior.alpha).squeeze(-2), 1))

    def _out(self, value: Tensor, power: int) -> Tensor:
        """``(*any, out or 1)`` in output units (squared if power is 2), in the interface's dtype."""
        value = self.units.value(value, power)
        return value.expand(*value.shape[:-1], self.out_features).to(self.dtype)

    def _out_slope(self, slope: Tensor, power: int, z: Tensor) -> Tensor:
        """Derivative by x of what is ``(*any, out or 1)`` in the learner's units."""
        slope = self.units.slope(slope, power, z)
        return slope.expand(*slope.shape[:-2], self.out_features, slope.shape[-1]).to(self.dtype)

    # -- what is known --------------------------------------------------------------------------

    @property
    def basis_inputs(self) -> Float[Tensor, "*batch slots in"]:
        """Basis points in the inputs' own units; only slots with ``posterior.active == 1`` count."""
        scale, shift = self.units.input.scale, self.units.input.shift
        return (self.posterior.basis * scale.unsqueeze(-2) + shift.unsqueeze(-2)).to(self.dtype)

    def __repr__(self) -> str:
        return "\n  ".join([f"{type(self).__name__}({self.extra_repr()})", *sparse_gp(self)])

    # -- learning -------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all samples and units; kernel and noise stay."""
        self.posterior.reset()
        self.units.reset()
        self.recent.reset()
        for part in self._parts:
            part.reset()
        for count in (self.pending, self.n_refused, self.largest):
            count.zero_()
        self.n_samples = 0

    def at_once(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport | None:
        return None if self.engine is None else self.engine.learn(self, x, y, mask)

    @torch.no_grad()
    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        on = None if mask is None else mask.to(x.dtype)
        self.recent.keep(self.n_samples, x, y, on)
        for part in self._parts:
            part.before_update(self, x, y, on)
        sample, anew = Sample(x, y, on, *self.project(x, y, on)), False
        self.recent.weigh(self.n_samples, sample.report.weight)
        for part in self._parts:
            anew |= part.after_update(self, sample)
        self.pending.add_(1.0 if on is None else on)  # += would register the buffer again
        for part in self._parts:
            part.act(self)
        self.count_sample(anew=anew)
        return sample.report

    def project(self, x: Tensor, y: Tensor, on: Tensor | None) -> tuple[UpdateReport, Tensor, Tensor]:
        """Learn one sample per model where ``on`` is 1; the last three fields of a :class:`Sample`."""
        z, t = self.units.input(x), self.units.output(y)
        weighing = [part for part in self._parts if type(part).weigh is not Part.weigh]
        return absorb(self.posterior, z, t, self.kernel, self.shared_noise(), on, weighing)

    def get_extra_state(self) -> dict[str, Any]:
        """Number of samples seen: the rhythm of rebuilds continues after a reload."""
        return {**super().get_extra_state(), "n_samples": self.n_samples}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.n_samples = int(state["n_samples"])


def default_parts() -> list[Part]:
    """What bears outliers, slow and abrupt changes, holds its intervals, and learns kernel and noise."""
    wandering = ProcessNoise(0.001)
    return [RobustWeight(3.0), DetectChanges(), wandering, CalibrateNoise(), LearnHyperparameters()]


def DeepKernelSOGP(  # noqa: N802  a kind of learner, called like the others
    in_features: int,
    out_features: int,
    *,
    hidden: Sequence[int] | None = None,
    features: int | None = None,
    seed: int = 0,
    base: StationaryKernel | None = None,
    parts: Iterable[nn.Module] | None = None,
    **options: Any,
) -> SparseOnlineGP:
    """A SparseOnlineGP on ``[x / L, net(x)]``, network and kernel learned online in constant memory.

    The basis is kept as inputs and embedded again whenever the network moves; the natural form does not
    contain the kernel, so nothing else has to follow. See DeepKernel and LearnHyperparameters.

    Thousands of weights want more than the last 32 samples, which on a trajectory are one place: 2000
    samples of the past are kept to learn them from, and each rebuild takes two steps. Where g wanders
    (``ProcessNoise``) the past is another g: one step, and no memory.

    Args:
        hidden, features: of the network; (64, 64) and 16, or (32, 32) and 6 without a memory.
        seed: of its weights.
        base: kernel on inputs and features, Matern 3/2 by default.
        parts: as of SparseOnlineGP, by default ``[RobustWeight(3.0), DetectChanges(), CalibrateNoise()]``;
            ``LearnHyperparameters`` is added if it is not among them.
        options: see SparseOnlineGP (without ``kernel``).

    Raises:
        ParameterError: from SparseOnlineGP and DeepKernel.
    """
    calibrated = [RobustWeight(3.0), DetectChanges(), CalibrateNoise()]
    own = calibrated if parts is None else copy_parts(parts)
    learning = next((part for part in own if isinstance(part, LearnHyperparameters)), None)
    if learning is None:
        wanders = any(isinstance(part, ProcessNoise) for part in own)
        learning = LearnHyperparameters() if wanders else LearnHyperparameters(steps=2, memory=2000)
        own.append(learning)
    fleet = fleet_options(options)
    kernel = DeepKernel(
        Matern32(in_features, **fleet) if base is None else base,
        hidden=hidden if hidden is not None else (64, 64) if learning.memory else (32, 32),
        features=features if features is not None else 16 if learning.memory else 6,
        seed=seed,
    )
    return SparseOnlineGP(in_features, out_features, kernel=kernel, parts=own, **options)
