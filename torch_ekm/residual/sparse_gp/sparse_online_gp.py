from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import nn
from torch.distributions import Normal

from ..._checks import check_count
from ...typing import Float, Tensor
from ..kernels.kernel import Kernel, check_kernel, log_parameter
from ..kernels.stationary import Matern32
from ..predictions import joint_draws
from ..printed import sparse_gp
from ..report import MomentsWithJacobians, UpdateReport
from .defaults import chosen_parts
from .engine.compiled import CompiledEngine
from .engine.reference import ReferenceEngine
from .part import Host, Part, Sample, Units
from .posterior import SparsePosterior
from .units import Standardize

_LATEST = 8  # rounds of ``refresh_every`` after which the caches are rebuilt in any case
_DRIFT = 1e-8  # beyond which they are rebuilt at once, see SparsePosterior.drift


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
        refresh_every: samples after which parts may change the state, and the caches are rebuilt. Without a
            part that does, and on the CPU, one looks whether they have drifted (four times as often where
            they do); they are rebuilt when they have, and at the latest after eight times as many.
        refresh_offset: samples by which this comes later, for learners that are not to do it at the same one.
        options: see ResidualLearner.

    Attributes:
        engine: what computes. Where numba is installed (extra ``fast``) compiled loops do updates and queries
            of one sample per model, on the CPU in float64; they agree with torch to rounding. A
            ``ReferenceEngine`` in its place uses torch alone.

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
        self.engine: ReferenceEngine = CompiledEngine()
        self.drifts = False  # the last look at the caches found them less exact than rounding would have it
        self.n_samples = 0  # on the host, so that the rhythm of rebuilds never asks the GPU
        self._parts, self.units = (), Units()
        for part in chosen_parts(parts, standardize):
            part.bind(self)
            self._parts += (part,)
        self.parts = nn.ModuleList(self._parts)
        self.weighing = _overriding(self._parts, "weigh")
        self._noting = _overriding(self._parts, "after_update")
        self._rebuilding = _overriding(self._parts, "on_rebuild", "after_rebuild")
        self._preparing = _overriding(self._parts, "before_update")

    # -- predictions ----------------------------------------------------------------------------

    def forward(self, x: Tensor) -> Tensor:
        """Posterior mean ``alpha' k(X, x)`` in the outputs' units, differentiable in x."""
        return self.engine.mean(self, x)

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """N(mean, var), with the observation noise added on request."""
        mean, variance = self.moments(x, observation=observation)
        return Normal(mean, variance.sqrt(), validate_args=False)

    def moments(self, x: Tensor, *, observation: bool = False) -> tuple[Tensor, Tensor]:
        """Mean and variance, with the observation noise on request."""
        return self.engine.observed(self, x) if observation else self.engine.moments(self, x)

    def both_moments(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, latent variance, and the same with the observation noise."""
        mean, variance = self.engine.moments(self, x)
        return mean, variance, variance + self.noise_variance.to(self.dtype)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and its derivative, ``(alpha'k, alpha' dk/dx)``, in closed form."""
        return self.engine.linearize(self, x)

    def slope_deviation(self, x: Tensor) -> Tensor:
        """Root of ``d2k(x, z)/dx dz + (dk/dx)' C dk/dx`` at ``z = x``, by column."""
        return self.engine.slope_deviation(self, x)

    def unit_draws(self, x: Tensor, n: int, generator: torch.Generator | None) -> Tensor:
        """From the covariance ``K(x, x') + k' C k'`` of the queries."""
        z = self.units.inputs(x).reshape(-1, *self.batch_shape, self.in_features).movedim(0, -2)
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
        return self.engine.jacobians(self, x)

    # -- what is known --------------------------------------------------------------------------

    @property
    def noise_variance(self) -> Float[Tensor, "*batch out"]:
        """Observation noise variance, in the outputs' own squared units."""
        noise = self.units.value(self.log_noise_variance.exp(), 2)
        for part in self._parts:
            noise = part.noise(noise)
        return noise

    @property
    def basis_inputs(self) -> Float[Tensor, "*batch slots in"]:
        """Basis points in the inputs' own units; only slots with ``posterior.active == 1`` count."""
        return self.units.sets_as_given(self.posterior.basis).to(self.dtype)

    def __repr__(self) -> str:
        return "\n  ".join([f"{type(self).__name__}({self.extra_repr()})", *sparse_gp(self)])

    # -- learning -------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all samples and units; kernel and noise stay."""
        self.posterior.reset()
        for part in self._parts:
            part.reset()
        for count in (self.pending, self.n_refused, self.largest):
            count.zero_()
        self.n_samples, self.drifts = 0, False

    def update(self, x: Tensor, y: Tensor, mask: Tensor | None = None) -> UpdateReport:
        """See :meth:`ResidualLearner.update`; single samples that the engine accepts skip its checks."""
        if mask is None:
            with self.lock:
                report = self.engine.learn(self, x, y, None)
                if report is not None:
                    return report
        return super().update(x, y, mask)

    @torch.no_grad()
    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        report = self.engine.learn(self, x, y, mask)
        if report is not None:
            return report
        on = None if mask is None else mask.to(x.dtype)
        for part in self._preparing:
            part.before_update(self, x, y, on)
        done = self.engine.absorb(self, x, y, on)
        anew = False
        if self._noting:
            sample = Sample(x, y, on, done.innovation, done.variance, done.report)
            for part in self._noting:
                anew |= part.after_update(self, sample)
        self.pending.add_(1.0 if on is None else on)  # += would register the buffer again
        self.count_sample(anew=anew)
        return done.report

    def count_sample(self, *, anew: bool = False) -> None:
        """After a sample and all notes of it: rebuild the caches when it is time, or at once."""
        n = self.n_samples + 1
        if self._rebuilding or self.device.type != "cpu":  # on a GPU looking would mean waiting
            anew |= self.is_due(n)
        else:
            every = max(self.refresh_every // 4, 1) if self.drifts else self.refresh_every
            anew |= n % every == 0 and self._is_stale(n)
        vars(self)["n_samples"] = n  # an assignment to a Module takes ten times as long
        if anew:
            self.refresh()

    def _is_stale(self, n: int) -> bool:
        """Whether the caches must be made again after n samples although no part changed the state."""
        if n % (_LATEST * self.refresh_every) == 0:
            return True
        drift = self.posterior.drift(self.kernel, self.shared_noise())
        self.drifts = drift > 0.01 * _DRIFT
        return drift > _DRIFT

    def get_extra_state(self) -> dict[str, Any]:
        """Number of samples seen: the rhythm of rebuilds continues after a reload."""
        return {**super().get_extra_state(), "n_samples": self.n_samples, "drifts": self.drifts}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.n_samples, self.drifts = int(state["n_samples"]), bool(state["drifts"])


def _overriding(parts: Iterable[Part], *names: str) -> tuple[Part, ...]:
    """Those of the parts that do something of their own in one of these methods."""
    return tuple(p for p in parts if any(getattr(type(p), name) is not getattr(Part, name) for name in names))
