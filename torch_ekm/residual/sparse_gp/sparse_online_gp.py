"""The sparse online Gaussian process of Csato & Opper, kept in its natural form."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch.distributions import Normal

from ...exceptions import ParameterError, ShapeError
from ...typing import Float, Tensor
from ..base import UpdateReport, check_count, check_finite, check_positive
from ..double_state import DoubleStateLearner
from ..kernels.action_linear import ActionLinearKernel
from ..kernels.kernel import Kernel, SquaredExponential, check_kernel, log_parameter
from ..prediction import Prediction
from .hyperparameters import PrequentialAdaptation
from .monitor import ChangeDetector, NoiseCalibration
from .posterior import SparsePosterior, compiled_absorb
from .units import LearnedUnits


class SparseOnlineGP(DoubleStateLearner):
    """``g ~ GP(0, k)``, ``y = g(x) + noise``, on at most ``capacity`` basis points::

        mean(x) = alpha' k(X, x),   var(x) = k(x, x) + k(X, x)' C k(X, x)

    One sample costs O(b^2 + b m), a prediction O(b m) for the mean and O(b^2) for the variance
    (b basis points, m outputs). A sample with novelty ``gamma = k** - k'Qk`` above the tolerance becomes
    a basis point, another is projected onto the basis by KL divergence; beyond the capacity the point
    with the lowest score is deleted, the same way (Csato & Opper, Neural Computation 14, 2002).

    The state is kept in natural form and the caches that predict are rebuilt from it by Cholesky every
    ``refresh_every`` samples (:class:`~torch_ekm.residual.sparse_gp.posterior.SparsePosterior`): the textbook
    recursion, which never rebuilds, ends in NaN on smooth trajectories. The state is float64 whatever
    ``dtype`` says, which is that of inputs and outputs: float32 cannot hold K^-1 of a smooth kernel.

    The outputs share the basis and one noise-to-signal ratio in the gain; each has its own scale and
    its own observation noise.

    Args:
        in_features, out_features, batch_shape, on_invalid, dtype, device: see ResidualLearner.
        capacity: largest number of basis points b.
        kernel: covariance function in the learner's (normalised) units; default squared exponential
            with lengthscale sqrt(in_features) and unit variance.
        noise_variance: s2 in the (normalised) output's squared units, one number or one per output.
        novelty_tolerance: smallest ``gamma / k**`` of a new basis point.
        jitter: nugget on k(x, x) at basis points, relative to k**.
        projection: ``"kl"``, or ``"fitc"``: novelty of a projected sample counts as noise.
        deletion: score by which a point goes: ``"kl"`` exact loss, ``"mean"`` its first term,
            ``"novelty"`` best explained by the others, ``"oldest"``; ``"freeze"``: a full basis stays.
        forgetting: factor on all earlier information per sample, in (0, 1], back to the prior in the
            end. Applied when the caches are rebuilt.
        diffusion: share of the prior variance that comes back per sample, in [0, 1): g itself wanders,
            ``g <- sqrt(1 - d) g + sqrt(d) new``, the forgetting of KRLS-T. It bounds the certainty of
            places visited often too, so it follows a change faster than ``forgetting`` does.
        robust: c of the weight ``min(1, c^2/z2)`` on a sample's gain, z2 its mean squared standardised
            innovation (after Altamirano et al., ICML 2024, centred on the prediction); None: weight 1.
        normalize: learn the units of inputs and outputs from the first ``normalize_for`` samples.
            Inputs are centred where the kernel is shift invariant; outputs are only scaled, so the
            prior mean stays 0.
        normalize_for: samples after which the units stand still.
        refresh_every: samples between two rebuilds of the caches.
        adapt: learn kernel and noise online, at every rebuild; see PrequentialAdaptation.
        adapt_rate: its first step on the logarithms of the hyperparameters.
        adapt_network_rate: its first step on a deep kernel's weights.
        adapt_steps: steps per rebuild.
        adapt_memory: samples of the past to learn the kernel from, too (ReplayMemory); 0: the last only.
            Not with ``diffusion``: where g wanders the past is another g.
        calibrate: make 90 % intervals hold 90 % of the samples of each output, see NoiseCalibration.
        detect_changes: start anew when most of the last samples were surprising, see ChangeDetector.
            Looks at the result of every update, so on a GPU it waits for it.
        compile_step: updates through torch.compile: needs a C++ compiler and a minute at the first one.

    Raises:
        ParameterError: a parameter is outside its range.
    """

    pending: Tensor

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        capacity: int = 100,
        kernel: Kernel | None = None,
        noise_variance: float | Tensor = 0.01,
        novelty_tolerance: float = 1e-4,
        jitter: float = 1e-6,
        projection: Literal["kl", "fitc"] = "kl",
        deletion: str = "kl",
        forgetting: float = 1.0,
        diffusion: float = 0.0,
        robust: float | None = None,
        normalize: bool = False,
        normalize_for: int = 1000,
        refresh_every: int = 32,
        adapt: bool = False,
        adapt_rate: float = 0.03,
        adapt_network_rate: float = 0.015,
        adapt_steps: int = 1,
        adapt_memory: int = 0,
        calibrate: bool = False,
        detect_changes: bool = False,
        compile_step: bool = False,
        batch_shape: tuple[int, ...] = (),
        on_invalid: Literal["raise", "skip"] = "raise",
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        options: dict[str, Any] = {"batch_shape": batch_shape, "on_invalid": on_invalid}
        super().__init__(in_features, out_features, dtype=dtype, device=device, **options)
        if not 0 < forgetting <= 1:
            raise ParameterError("forgetting", forgetting, "in (0, 1]")
        if not 0 <= diffusion < 1:
            raise ParameterError("diffusion", diffusion, "in [0, 1)")
        self.capacity = check_count("capacity", capacity)
        self.refresh_every = check_count("refresh_every", refresh_every)
        self.forgetting, self.diffusion = float(forgetting), float(diffusion)
        self.compile_step = bool(compile_step)
        factory: dict[str, Any] = {"dtype": torch.float64, "device": device}
        fleet = {"batch_shape": self.batch_shape, **factory}
        kernel = SquaredExponential(self.in_features, **fleet) if kernel is None else kernel
        self.kernel = check_kernel(kernel, self.in_features, self.batch_shape).to(**factory)
        self.log_noise_variance = log_parameter(
            "noise_variance", noise_variance, (*self.batch_shape, self.out_features), **factory
        )
        learn_for = check_count("normalize_for", normalize_for) if normalize else 0
        shifted = self.kernel.shift_invariant(self.in_features) if normalize else []
        self.units = LearnedUnits(self.in_features, self.out_features, learn_for, shifted, **fleet)
        self.posterior = SparsePosterior(
            self.in_features,
            self.out_features,
            self.capacity,
            novelty_tolerance=novelty_tolerance,
            jitter=jitter,
            projection=projection,
            deletion=deletion,
            robust=None if robust is None else check_positive("robust", robust),
            batch_shape=self.batch_shape,
            device=device,
        )
        if adapt_memory and diffusion > 0.0:
            raise ParameterError(
                "adapt_memory", adapt_memory, "0 with diffusion: the past is that of another g"
            )
        places = {"batch_shape": self.batch_shape, "device": device}
        self.calibration = NoiseCalibration(self.out_features, **places) if calibrate else None
        self.detector = None
        if detect_changes:
            self.detector = ChangeDetector(self.in_features, self.out_features, **places)
        adaptation = {
            "rate": check_positive("adapt_rate", adapt_rate),
            "network_rate": check_positive("adapt_network_rate", adapt_network_rate),
            "steps": check_count("adapt_steps", adapt_steps),
            "memory": check_count("adapt_memory", adapt_memory, least=0),
            "window": self.refresh_every,
            "forgetting": self.forgetting,
            "expects_changes": detect_changes,
        }
        state = (self.posterior, self.kernel, self.log_noise_variance)
        self.adaptation = PrequentialAdaptation(*state, **adaptation) if adapt else None
        # samples whose forgetting is due at the next rebuild
        self.register_buffer("pending", torch.zeros(self.batch_shape, **factory))
        self._n_samples = 0  # on the host, so that the rhythm of rebuilds never asks the GPU

    # -- predictions ----------------------------------------------------------------------------

    def forward(self, x: Tensor) -> Tensor:
        """``alpha' k(X, x)``, differentiable in x."""
        k = self._cross(self.units.inputs(self._check_query(x)))
        return self._out((k.unsqueeze(-2) @ self.posterior.alpha).squeeze(-2), 1)

    def variance(self, x: Float[Tensor, "*any in"]) -> Float[Tensor, "*any out"]:
        """Latent variance ``k** + k'Ck`` of each output, differentiable in x."""
        z = self.units.inputs(self._check_query(x))
        k = self._cross(z).unsqueeze(-1)
        v = self.kernel.diagonal(z) + (k.mT @ (self.posterior.covariance @ k)).squeeze(-1).squeeze(-1)
        return self._out(v.clamp_min(0.0).unsqueeze(-1), 2)

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """N(mean, var), with the observation noise added on request."""
        variance = self.variance(x)
        if observation:
            variance = variance + self.noise_variance.to(self.dtype)
        return Normal(self(x), variance.sqrt(), validate_args=False)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """``(alpha'k, alpha' dk/dx)`` in closed form."""
        k, dk = self._cross_with_gradient(self.units.inputs(self._check_query(x)))
        coefficients = self.posterior.alpha.mT
        mean, jacobian = (coefficients @ k.unsqueeze(-1)).squeeze(-1), coefficients @ dk
        return self._out(mean, 1), self._out_slope(jacobian, 1)

    def predict_with_jacobians(self, x: Float[Tensor, "*any in"]) -> Prediction:
        """Mean, latent variance and both derivatives, in closed form::

        d mean/dx = alpha' dk/dx,   d var/dx = dk(x,x)/dx + 2 (Ck)' dk/dx
        """
        z = self.units.inputs(self._check_query(x))
        k, dk = self._cross_with_gradient(z)
        column = k.unsqueeze(-1)
        Ck = self.posterior.covariance @ column
        alpha = self.posterior.alpha
        # alpha and Ck side by side share one pass over k and one over dk
        left = torch.cat([alpha.expand(*Ck.shape[:-1], alpha.shape[-1]), Ck], dim=-1).mT
        values, slopes = (left @ column).squeeze(-1), left @ dk
        v = (self.kernel.diagonal(z) + values[..., -1]).clamp_min(0.0).unsqueeze(-1)
        dv = self.kernel.diagonal_gradient(z).unsqueeze(-2) + 2.0 * slopes[..., -1:, :]
        return Prediction(
            self._out(values[..., :-1], 1),
            self._out(v, 2),
            self._out_slope(slopes[..., :-1, :], 1),
            self._out_slope(dv, 2),
        )

    def action_jacobian(self, s: Float[Tensor, "*any n_s"]) -> Float[Tensor, "*any out n_a"]:
        """G(s) with ``mean(s, a) = G(s) a`` exactly: ``G = sum_i alpha_i k_s(s, s_i) (Lambda a_i)'``.

        Raises:
            ParameterError: the kernel is not action-linear.
        """
        _, B = self._action_features(s)
        return self._out_slope(self.posterior.alpha.mT @ B, 1)

    def action_covariance(self, s: Float[Tensor, "*any n_s"]) -> Float[Tensor, "*any out n_a n_a"]:
        """V(s) with ``var(s, a)_j = a' V_j(s) a`` exactly: ``V = k_s(s,s) Lambda + B'CB``, B as in G.

        Raises:
            ParameterError: the kernel is not action-linear.
        """
        kernel, B = self._action_features(s)
        V = kernel.action_prior(self.units.inputs(s)) + B.mT @ (self.posterior.covariance @ B)
        if not self.units.learn_for:
            return V.unsqueeze(-3).expand(*V.shape[:-2], self.out_features, *V.shape[-2:]).to(self.dtype)
        inverse = 1.0 / self.units.input.scale[..., kernel.state_features :]
        V = V * (inverse.unsqueeze(-1) * inverse.unsqueeze(-2))
        return (V.unsqueeze(-3) * self.units.output.scale.square()[..., None, None]).to(self.dtype)

    # -- what is known --------------------------------------------------------------------------

    @property
    def noise_variance(self) -> Float[Tensor, "*batch out"]:
        """Observation noise variance, in the outputs' own squared units."""
        noise = self.units.value(self.log_noise_variance.exp(), 2)
        return noise if self.calibration is None else noise * self.calibration.log_factor.exp()

    @property
    def basis_inputs(self) -> Float[Tensor, "*batch slots in"]:
        """Basis points in the inputs' own units; only slots with ``posterior.active == 1`` count."""
        return self.units.sets_as_given(self.posterior.basis).to(self.dtype)

    @property
    def condition_number(self) -> Float[Tensor, "*batch"]:
        """Condition of the basis' kernel matrix (2-norm)."""
        return torch.linalg.cond(self.posterior.gram(self.kernel))

    # -- learning -------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all samples and units; kernel and noise stay."""
        self.posterior.reset()
        self.units.reset()
        for part in (self.adaptation, self.calibration, self.detector):
            if part is not None:
                part.reset()
        self.pending.zero_()
        self.n_refused.zero_()
        self._n_samples = 0

    @torch.no_grad()
    def set_basis(self, x: Float[Tensor, "n *batch in"]) -> None:
        """Start anew from the prior on given basis points (at most ``capacity``).

        With ``deletion="freeze"`` and a full basis the posterior is then the DTC approximation
        (FITC with ``projection="fitc"``) on these inducing points.

        Raises:
            ShapeError: the shape does not fit, or there are more points than the capacity.
            NonFiniteError: NaN or infinity; the state is untouched.
        """
        x = self._cast(x)
        check_finite("x", x)
        if x.shape[1:] != (*self.batch_shape, self.in_features) or not 1 <= len(x) <= self.capacity:
            raise ShapeError("x", self._expected(f"[n <= {self.capacity}]", "in"), x.shape)
        self.reset()
        self.posterior.place(x.movedim(0, -2))
        self.refresh()

    @torch.no_grad()
    def refresh(self) -> None:
        """Forget what is due, adopt new units and rebuild the caches from the natural form.

        Call it after a change of the kernel's or the noise's parameters.
        """
        posterior = self.posterior
        if self.forgetting < 1.0:
            factor = (self.forgetting**self.pending)[..., None, None]
            posterior.precision.mul_(factor)
            posterior.information.mul_(factor)
        if self.diffusion > 0.0:
            posterior.diffuse(self.kernel, self._shared_noise(), (1.0 - self.diffusion) ** self.pending)
        self.pending.zero_()
        if self.units.learning(self._n_samples):
            offset, ratio, ratio_t = self.units.settle()
            posterior.basis.add_(offset.unsqueeze(-2)).mul_(ratio.unsqueeze(-2))
            posterior.information.mul_(ratio_t.unsqueeze(-2))
        posterior.rebuild(self.kernel, self._shared_noise())
        if self.adaptation is not None:
            self.adaptation.snapshot(posterior)

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        on = None if mask is None else mask.to(x.dtype)
        z, t = self.units.inputs(x), self.units.targets(y)
        s2 = self._shared_noise()
        number = self._n_samples if self.posterior.needs_age else 0
        step = compiled_absorb(x.device.type) if self.compile_step else SparsePosterior.absorb
        report, innovation, v = step(self.posterior, z, t, self.kernel, s2, on, number)
        if self.calibration is not None:
            self.calibration.observe(innovation, v, self.log_noise_variance.exp(), on)
        if self.detector is not None:
            self._start_anew(self.detector.observe(x, y, report.surprise, on))
        self.pending += 1.0 if on is None else on
        if self.units.learning(self._n_samples):
            used = torch.ones_like(report.weight) if on is None else on
            self.units.observe(x, y, used, report.weight)
        n = self._n_samples = self._n_samples + 1
        due = n % self.refresh_every == 0
        if self.adaptation is not None:
            self.adaptation.observe(x, y, on, report.weight, (n - 1) % self.refresh_every)
            if due:
                self.adaptation.descend(self.kernel, self.log_noise_variance, self.units.of_sets)
        # Units are rough in the first samples: then rebuild at 1, 2, 4, 8, ... too.
        if due or (self.units.learning(n) and n & (n - 1) == 0):
            self.refresh()
        return report

    def _start_anew(self, changed: Tensor) -> None:
        """Models that face another system forget the old one and learn the samples that showed it."""
        if self.detector is None or not bool(changed.any()):
            return
        self.posterior.forget(changed)
        if self.adaptation is not None:
            self.adaptation.forget(changed)
        self.pending.masked_fill_(changed, 0.0)
        kept = (self.detector.inputs, self.detector.targets, self.detector.since_change)
        for x, y, used in zip(*kept, strict=True):
            t = self.units.targets(y)
            on = (used & changed).to(x.dtype)
            self.posterior.absorb(
                self.units.inputs(x), t, self.kernel, self._shared_noise(), on, self._n_samples
            )

    # -- pieces ---------------------------------------------------------------------------------

    def _shared_noise(self) -> Tensor:
        """Noise by which the gain is computed: geometric mean over the (normalised) outputs."""
        return self.log_noise_variance.mean(-1).exp()

    def _out(self, value: Tensor, power: int) -> Tensor:
        """``(*any, out or 1)`` in output units (squared if power is 2), in the interface's dtype."""
        value = self.units.value(value, power)
        return value.expand(*value.shape[:-1], self.out_features).to(self.dtype)

    def _out_slope(self, slope: Tensor, power: int) -> Tensor:
        """``(*any, out or 1, columns)``: derivative by the last columns of x."""
        slope = self.units.slope(slope, power)
        return slope.expand(*slope.shape[:-2], self.out_features, slope.shape[-1]).to(self.dtype)

    def _cross(self, z: Tensor) -> Tensor:
        return self.kernel.vector(z, self.posterior.basis) * self.posterior.active

    def _cross_with_gradient(self, z: Tensor) -> tuple[Tensor, Tensor]:
        # free slots need no mask here: their rows in alpha and C are 0
        return self.kernel.with_gradient(z, self.posterior.basis)

    def _action_features(self, s: Tensor) -> tuple[ActionLinearKernel, Tensor]:
        kernel = self.kernel
        if not isinstance(kernel, ActionLinearKernel):
            raise ParameterError("kernel", type(kernel).__name__, "an ActionLinearKernel for this method")
        s = self._cast(s)
        if s.shape[-1:] != (kernel.state_features,):
            raise ShapeError("s", f"(*any, {kernel.state_features})", s.shape)
        return kernel, kernel.action_features_of(self.units.inputs(s), self.posterior.basis)

    def _cast(self, x: Tensor) -> Tensor:
        return torch.as_tensor(x, dtype=torch.float64, device=self.device)

    def get_extra_state(self) -> dict[str, Any]:
        """Number of samples seen: the rhythm of rebuilds continues after a reload."""
        return {"n_samples": self._n_samples}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See get_extra_state."""
        self._n_samples = int(state["n_samples"])
