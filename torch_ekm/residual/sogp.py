"""The sparse online Gaussian process of Csato & Opper, kept in its natural form."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import torch
from torch.distributions import Normal

from ..exceptions import ParameterError, ShapeError
from ..typing import Float, Tensor
from .action_linear import ActionLinearKernel
from .base import ResidualLearner, UpdateEvent, UpdateReport, check_count, check_positive
from .deletion import DELETION_SCORES
from .kernels import Kernel, SquaredExponential, log_parameter
from .natural import posterior_from_natural
from .running_scale import RunningScale


class Prediction(NamedTuple):
    """Mean, latent variance and their derivatives with respect to x."""

    mean: Float[Tensor, "*any out"]
    variance: Float[Tensor, "*any out"]
    mean_jacobian: Float[Tensor, "*any out in"]
    variance_jacobian: Float[Tensor, "*any out in"]


class SparseOnlineGP(ResidualLearner):
    """``g ~ GP(0, k)``, ``y = g(x) + noise``, on at most ``capacity`` basis points::

        mean(x) = alpha' k(X, x),   var(x) = k(x, x) + k(X, x)' C k(X, x)

    One sample costs O(b^2 + b m), a prediction O(b m) for the mean and O(b^2) for the variance
    (b basis points, m outputs). A sample whose novelty ``gamma = k** - k'Qk`` reaches the tolerance
    becomes a basis point, another is projected onto the basis with the smallest loss in KL
    divergence; beyond the capacity the point with the lowest score is deleted, again by KL
    projection (Csato & Opper, Neural Computation 14, 2002).

    Master copy is the natural form ``exp(-1/2 f' Omega f / s2 + h'f / s2)``: Omega is a sum of
    squares, so it stays positive, and it holds neither kernel nor noise, so both may change without
    stored data. (alpha, C, Q) are caches, carried along by rank-one steps and rebuilt from the
    natural form by Cholesky every ``refresh_every`` samples: the textbook recursion, which never
    rebuilds, ends in NaN on smooth trajectories.

    The outputs share the basis and one noise-to-signal ratio; each has its own scale and noise.

    Args:
        in_features, out_features, batch_shape, on_invalid, dtype, device: see ResidualLearner.
        capacity: largest number of basis points b.
        kernel: covariance function in the learner's (normalised) units; default squared exponential
            with lengthscale sqrt(in_features) and unit variance.
        noise_variance: s2 in the (normalised) output's squared units, one number or one per output.
        novelty_tolerance: smallest ``gamma / k**`` of a new basis point; by default 1e-4 in
            float64 and 1e-2 in float32.
        jitter: nugget on k(x, x) at basis points, relative to k**; default 1e-8, 1e-6 in float32.
        projection: ``"kl"``, or ``"fitc"``, which counts a projected sample's novelty as noise and so
            is less confident.
        deletion: score by which a basis point goes, a name in ``DELETION_SCORES``: ``"kl"`` exact
            loss, ``"mean"`` its first term, ``"novelty"`` the point best explained by the others,
            ``"oldest"``, or ``"freeze"``: once full, the basis stays.
        forgetting: factor on all earlier information per sample, in (0, 1]; without new samples the
            posterior returns to the prior. Applied when the caches are rebuilt.
        robust: c of the weight ``1 / (1 + z2/c^2)`` of a sample with mean squared standardised
            innovation z2; None trusts all samples (Altamirano et al., ICML 2024, centred on the
            prediction).
        normalize: learn the units of inputs and outputs from the first ``normalize_for`` samples.
            Inputs are centred where the kernel is shift invariant; outputs are only scaled, so the
            prior mean stays 0.
        normalize_for: samples after which the units stand still.
        refresh_every: samples between two rebuilds of the caches.

    Raises:
        ParameterError: a parameter is outside its range.
    """

    basis: Tensor
    active: Tensor
    count: Tensor
    slot: Tensor
    age: Tensor
    pending: Tensor
    _moments: Tensor
    _vectors: Tensor

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        capacity: int = 100,
        kernel: Kernel | None = None,
        noise_variance: float | Tensor = 0.01,
        novelty_tolerance: float | None = None,
        jitter: float | None = None,
        projection: Literal["kl", "fitc"] = "kl",
        deletion: str = "kl",
        forgetting: float = 1.0,
        robust: float | None = None,
        normalize: bool = False,
        normalize_for: int = 1000,
        refresh_every: int = 16,
        batch_shape: tuple[int, ...] = (),
        on_invalid: Literal["raise", "skip"] = "raise",
        dtype: torch.dtype = torch.float64,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__(
            in_features,
            out_features,
            batch_shape=batch_shape,
            on_invalid=on_invalid,
            dtype=dtype,
            device=device,
        )
        factory = {"dtype": dtype, "device": device}
        fleet = {"batch_shape": self.batch_shape, **factory}
        double = dtype == torch.float64
        self.capacity = check_count("capacity", capacity)
        self.refresh_every = check_count("refresh_every", refresh_every)
        self.novelty_tolerance = (
            (1e-4 if double else 1e-2) if novelty_tolerance is None else novelty_tolerance
        )
        if not 0 <= self.novelty_tolerance < 1:
            raise ParameterError("novelty_tolerance", novelty_tolerance, "in [0, 1)")
        self.jitter = (1e-8 if double else 1e-6) if jitter is None else jitter
        if not 0 <= self.jitter < 1:
            raise ParameterError("jitter", jitter, "in [0, 1)")
        if not 0 < forgetting <= 1:
            raise ParameterError("forgetting", forgetting, "in (0, 1]")
        if projection not in ("kl", "fitc"):
            raise ParameterError("projection", projection, "'kl' or 'fitc'")
        if deletion not in (*DELETION_SCORES, "freeze"):
            raise ParameterError("deletion", deletion, f"one of {(*DELETION_SCORES, 'freeze')}")
        self.forgetting, self.projection, self.deletion = float(forgetting), projection, deletion
        self.robust = None if robust is None else check_positive("robust", robust)
        self.kernel = SquaredExponential(self.in_features, **fleet) if kernel is None else kernel
        self.log_noise_variance = log_parameter(
            "noise_variance", noise_variance, (*self.batch_shape, self.out_features), **factory
        )
        self.normalize_for = check_count("normalize_for", normalize_for) if normalize else 0
        shifted = self.kernel.shift_invariant(self.in_features)
        self.input_scale = RunningScale(self.in_features, shifted, **fleet) if normalize else None
        self.output_scale = RunningScale(self.out_features, **fleet) if normalize else None

        # One slot more than the capacity: a new point moves in before another is deleted.
        M, shape = self.capacity + 1, self.batch_shape
        self.register_buffer("basis", torch.zeros(*shape, M, self.in_features, **factory))
        self.register_buffer("active", torch.zeros(*shape, M, **factory))
        self.register_buffer("age", torch.zeros(*shape, M, **factory))  # sample number of each point
        self.register_buffer("count", torch.zeros(shape, dtype=torch.int64, device=device))
        self.register_buffer("slot", torch.zeros(shape, dtype=torch.int64, device=device))
        self.register_buffer("pending", torch.zeros(shape, **factory))  # samples not yet forgotten
        # [C; Q; Omega] and [alpha; h] each in one buffer: one product, one update serves all.
        self.register_buffer("_moments", torch.zeros(*shape, 3, M, M, **factory))
        self.register_buffer("_vectors", torch.zeros(*shape, 2, M, self.out_features, **factory))
        self.register_buffer("_slots", torch.arange(M, device=device), persistent=False)
        self._n_samples = 0  # on the host, so that the rhythm of rebuilds never asks the GPU

    # -- predictions ----------------------------------------------------------------------------

    def forward(self, x: Tensor) -> Tensor:
        """``alpha' k(X, x)``, differentiable in x."""
        z = self._normalized(self._check_query(x))
        mean = (self._cross(z).unsqueeze(-2) @ self.alpha).squeeze(-2)
        return mean if self.output_scale is None else mean * self.output_scale.scale

    def variance(self, x: Float[Tensor, "*any in"]) -> Float[Tensor, "*any out"]:
        """Latent variance ``k** + k'Ck`` of each output, differentiable in x."""
        z = self._normalized(self._check_query(x))
        k = self._cross(z)
        v = self.kernel.diagonal(z) + ((k.unsqueeze(-2) @ self._moments[..., 0, :, :]).squeeze(-2) * k).sum(
            -1
        )
        return self._output_variance(v)

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """N(mean, var), with the observation noise added on request."""
        variance = self.variance(x)
        if observation:
            variance = variance + self.noise_variance
        return Normal(self(x), variance.sqrt(), validate_args=False)

    def linearize(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """``(alpha'k, alpha' dk/dx)`` in closed form."""
        z = self._normalized(self._check_query(x))
        k, dk = self._cross_with_gradient(z)
        mean, jacobian = (k.unsqueeze(-2) @ self.alpha).squeeze(-2), self.alpha.mT @ dk
        if self.input_scale is not None and self.output_scale is not None:
            mean = mean * self.output_scale.scale
            jacobian = jacobian * (
                self.output_scale.scale.unsqueeze(-1) / self.input_scale.scale.unsqueeze(-2)
            )
        return mean, jacobian

    def predict_with_jacobians(self, x: Float[Tensor, "*any in"]) -> Prediction:
        """Mean, latent variance and both derivatives, in closed form::

        d mean/dx = alpha' dk/dx,   d var/dx = dk(x,x)/dx + 2 (Ck)' dk/dx
        """
        z = self._normalized(self._check_query(x))
        k, dk = self._cross_with_gradient(z)
        Ck = (self._moments[..., 0, :, :] @ k.unsqueeze(-1)).squeeze(-1)
        # Products with alpha and Ck share one pass over k and dk each.
        left = torch.cat([self.alpha.expand(*Ck.shape, -1), Ck.unsqueeze(-1)], dim=-1).mT
        values = (left @ k.unsqueeze(-1)).squeeze(-1)
        slopes = left @ dk
        mean, jacobian = values[..., :-1], slopes[..., :-1, :]
        v = self.kernel.diagonal(z) + values[..., -1]
        dv = self.kernel.diagonal_gradient(z) + 2.0 * slopes[..., -1, :]
        if self.input_scale is not None and self.output_scale is not None:
            out, inv = self.output_scale.scale, 1.0 / self.input_scale.scale
            mean, dv = mean * out, dv * inv
            jacobian = jacobian * out.unsqueeze(-1) * inv.unsqueeze(-2)
            return Prediction(
                mean, self._output_variance(v), jacobian, (out * out).unsqueeze(-1) * dv.unsqueeze(-2)
            )
        return Prediction(mean, self._output_variance(v), jacobian, dv.unsqueeze(-2).expand_as(jacobian))

    def action_jacobian(self, s: Float[Tensor, "*any n_s"]) -> Float[Tensor, "*any out n_a"]:
        """G(s) with ``mean(s, a) = G(s) a`` exactly: ``G = sum_i alpha_i k_s(s, s_i) (Lambda a_i)'``.

        Raises:
            ParameterError: the kernel is not action-linear.
        """
        B, _ = self._action_features(s)
        G = self.alpha.mT @ B
        if self.input_scale is not None and self.output_scale is not None:
            n_s = s.shape[-1]
            G = G * self.output_scale.scale.unsqueeze(-1) / self.input_scale.scale[..., None, n_s:]
        return G

    def action_covariance(self, s: Float[Tensor, "*any n_s"]) -> Float[Tensor, "*any out n_a n_a"]:
        """V(s) with ``var(s, a)_j = a' V_j(s) a`` exactly: ``V = k_s(s,s) Lambda + B'CB``, B as in G.

        Raises:
            ParameterError: the kernel is not action-linear.
        """
        B, prior = self._action_features(s)
        V = (prior + B.mT @ self._moments[..., 0, :, :] @ B).unsqueeze(-3)
        if self.input_scale is not None and self.output_scale is not None:
            inv = 1.0 / self.input_scale.scale[..., s.shape[-1] :]
            out = self.output_scale.scale.square()[..., None, None]
            return V * (inv.unsqueeze(-1) * inv.unsqueeze(-2)).unsqueeze(-3) * out
        return V.expand(*V.shape[:-3], self.out_features, *V.shape[-2:])

    # -- what is known --------------------------------------------------------------------------

    @property
    def alpha(self) -> Float[Tensor, "*batch slots out"]:
        """Coefficients of the mean, in normalised output units; rows of free slots are 0."""
        return self._vectors[..., 0, :, :]

    @property
    def noise_variance(self) -> Float[Tensor, "*batch out"]:
        """Observation noise variance, in the outputs' own squared units."""
        noise = self.log_noise_variance.exp()
        return noise if self.output_scale is None else noise * self.output_scale.scale.square()

    @property
    def basis_inputs(self) -> Float[Tensor, "*batch slots in"]:
        """Basis points in the inputs' own units; only slots with ``active == 1`` mean anything."""
        if self.input_scale is None:
            return self.basis
        return self.basis * self.input_scale.scale.unsqueeze(-2) + self.input_scale.shift.unsqueeze(-2)

    @property
    def condition_number(self) -> Float[Tensor, "*batch"]:
        """Condition of the basis' kernel matrix (2-norm)."""
        return torch.linalg.cond(self._gram().double()).to(self.dtype)

    # -- learning -------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all samples and units; kernel and noise stay."""
        for buffer in (self.basis, self.active, self.age, self.count, self.slot, self.pending):
            buffer.zero_()
        for buffer in (self._moments, self._vectors, self.n_refused):
            buffer.zero_()
        if self.input_scale is not None and self.output_scale is not None:
            self.input_scale.reset()
            self.output_scale.reset()
        self._n_samples = 0

    @torch.no_grad()
    def set_basis(self, x: Float[Tensor, "n *batch in"]) -> None:
        """Start anew from the prior on given basis points (at most ``capacity``).

        With ``deletion="freeze"`` and a full basis the posterior is then the DTC approximation
        (FITC with ``projection="fitc"``) on these inducing points.

        Raises:
            ShapeError: the shape does not fit, or there are more points than the capacity.
        """
        x = self._cast(x)
        if x.shape[1:] != (*self.batch_shape, self.in_features) or not 1 <= len(x) <= self.capacity:
            raise ShapeError("x", self._expected(f"[n <= {self.capacity}]", "in"), x.shape)
        self.reset()
        self.basis[..., : len(x), :] = x.movedim(0, -2)
        self.active[..., : len(x)] = 1.0
        self.count.fill_(len(x))
        self.slot.fill_(len(x))
        self.refresh()

    @torch.no_grad()
    def refresh(self) -> None:
        """Forget what is due, adopt new units and rebuild (alpha, C, Q) from the natural form.

        Call it after a change of the kernel's or the noise's parameters.
        """
        C, Q, Omega = self._moments.unbind(-3)
        alpha, h = self._vectors.unbind(-3)
        if self.forgetting < 1.0:
            factor = (self.forgetting**self.pending)[..., None, None]
            Omega.mul_(factor)
            h.mul_(factor)
        self.pending.zero_()
        if self._normalizing and self.input_scale is not None and self.output_scale is not None:
            offset, ratio = self.input_scale.settle()
            self.basis.add_(offset.unsqueeze(-2)).mul_(ratio.unsqueeze(-2))
            h.mul_(self.output_scale.settle()[1].unsqueeze(-2))
        s2 = self._shared_noise()[..., None, None]
        new_Q, new_C, new_alpha = posterior_from_natural(self._gram(), Omega / s2, h / s2)
        on = self.active.unsqueeze(-1)
        Q.copy_(new_Q * on * on.mT)
        C.copy_(new_C * on * on.mT)
        alpha.copy_(new_alpha * on)

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        z = self._normalized(x)
        t = y if self.output_scale is None else y / self.output_scale.scale
        report = self._step(z, t, None if mask is None else mask.to(self.dtype))
        self._n_samples += 1
        if self._normalizing and self.input_scale is not None and self.output_scale is not None:
            weight = report.weight if mask is None else report.weight * mask
            self.input_scale.observe(x, torch.ones_like(weight) if mask is None else mask.to(self.dtype))
            self.output_scale.observe(y, weight)
        # Units are rough in the first samples: then rebuild at 1, 2, 4, 8, ... too.
        n = self._n_samples
        if n % self.refresh_every == 0 or (self._normalizing and n & (n - 1) == 0):
            self.refresh()
        return report

    def _step(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        """One sample per model, without a branch on data (a mask multiplies every change by 0).

        e = Qk, gamma = k** - k'e, v = k** + k'Ck, D = s2 + v, i = y - mean. A novel sample takes
        slot j with t = 1_j, others are projected with t = e and D = s2 + v - gamma. With s = Ck + t:
        alpha += s i'/D, C -= s s'/D, Omega += t t', h += t y', and for novel ones Q += p p'/gamma,
        p = e - 1_j.
        """
        M, tail = self.capacity + 1, (-2, -1)
        here = self._slots == self.slot.unsqueeze(-1)
        k = self.kernel.vector(x, self.basis) * self.active
        prior = self.kernel.diagonal(x) * (1.0 + self.jitter)
        products = (self._moments[..., :2, :, :].flatten(-3, -2) @ k.unsqueeze(-1)).unflatten(-2, (2, M))
        Ck, e = products.squeeze(-1).unbind(-2)
        kCk, ke = (products.squeeze(-1) @ k.unsqueeze(-1)).squeeze(-1).unbind(-1)
        gamma, v = (prior - ke).clamp_min(0.0), prior + kCk
        innovation = y - (k.unsqueeze(-2) @ self.alpha).squeeze(-2)

        s2 = noise = self._shared_noise()
        surprise = innovation.square().mean(-1) / (s2 + v)
        weight = torch.ones_like(surprise)
        if self.robust is not None:
            weight = 1.0 / (1.0 + surprise / self.robust**2)
            noise = s2 / weight
        full = self.count == self.capacity
        novel = gamma > self.novelty_tolerance * prior
        if self.deletion == "freeze":
            novel = novel & ~full
        known = gamma * ~novel  # novelty that a projection drops
        if self.projection == "fitc":
            noise = noise + known
        gain, precision = 1.0 / (noise + v - known), s2 / noise
        if mask is not None:
            novel, gain, precision = novel & (mask > 0), gain * mask, precision * mask

        unit = here.to(e.dtype)
        t = torch.where(novel.unsqueeze(-1), unit, e)
        s = Ck + t
        p = e - unit
        grow = torch.where(novel, 1.0 / gamma, 0.0)
        left, right = torch.stack([s, p, t], dim=-2), torch.stack([-gain, grow, precision], dim=-1)
        self._rank_update(self._moments, (left * right.unsqueeze(-1)).unsqueeze(-1), left.unsqueeze(-1))
        values = torch.stack([innovation * gain.unsqueeze(-1), y * precision.unsqueeze(-1)], dim=-2)
        self._rank_update(self._vectors, torch.stack([s, t], dim=-2).unsqueeze(-1), values.unsqueeze(-1))

        # The slot's content does not matter while it is free, so it can be written in any case.
        where = self.slot[..., None]
        if mask is None:
            self.basis.scatter_(-2, where.unsqueeze(-1).expand_as(x.unsqueeze(-2)), x.unsqueeze(-2))
            self.pending += 1.0
        else:
            self.basis.copy_(
                torch.where((here & (mask > 0).unsqueeze(-1)).unsqueeze(-1), x.unsqueeze(-2), self.basis)
            )
            self.pending += mask
        self.active.scatter_(-1, where, novel.to(e.dtype).unsqueeze(-1))
        self.age.scatter_(-1, where, torch.full_like(where, self._n_samples, dtype=e.dtype))
        excess = novel & full
        self.count += novel & ~full
        self.slot += novel & ~full
        if self.deletion != "freeze" and self._any(excess):
            self._delete(excess)
        event = UpdateEvent.ABSORBED + novel.to(torch.int64) + excess
        if mask is not None:
            event = event * (mask > 0)
        return UpdateReport(event, gamma / prior, surprise, weight)

    def _delete(self, excess: Tensor) -> None:
        """KL projection of the lowest-scored point onto the others, where ``excess``.

        With a, c, q its entries in alpha, C, Q, stars its remaining columns and e = -Q*/q:
        alpha -= (C*+Q*) a'/(c+q), C += Q*Q*'/q - (C*+Q*)(C*+Q*)'/(c+q), Q -= Q*Q*'/q,
        Omega <- P'Omega P, h <- P'h, P = [I; e'].
        """
        M, dtype = self.capacity + 1, self._moments.dtype
        c_diag, q_diag, w_diag = self._moments.diagonal(dim1=-2, dim2=-1).unbind(-2)
        score = DELETION_SCORES[self.deletion](
            self.alpha, c_diag, q_diag, w_diag / self._shared_noise().unsqueeze(-1), self.age
        )
        i = torch.where(self.active > 0, score, torch.inf).argmin(-1, keepdim=True)
        at = self._slots == i
        pick = i[..., None, None].expand(*self.batch_shape, 3, M, 1)
        columns = self._moments.gather(-1, pick).squeeze(-1)  # C, Q, Omega: (..., 3, M)
        c, q, w = columns.gather(-1, i.unsqueeze(-2).expand(*self.batch_shape, 3, 1)).unbind(-2)
        away = (~at).to(dtype)
        C, Q, Om = (columns * away.unsqueeze(-2)).unbind(-2)
        on = excess.to(dtype).unsqueeze(-1)
        q_inv = on / q
        # c + q >= 0 is the point's remaining uncertainty; rounding must not turn it negative.
        cq_inv = on / torch.maximum(c + q, 100 * torch.finfo(dtype).eps * q)
        CQ, e = C + Q, -Q * q_inv
        u = Om * on + 0.5 * w * e
        zero = torch.zeros_like(Q)
        left = torch.stack([Q * q_inv, -CQ * cq_inv, -Q * q_inv, zero, u, e], dim=-2)
        right = torch.stack([Q, CQ, Q, zero, e, u], dim=-2)
        halves = (*self.batch_shape, 3, 2, M)
        self._rank_update(self._moments, left.view(halves).mT, right.view(halves).mT)
        rows = self._vectors.gather(-2, i[..., None, None].expand(*self.batch_shape, 2, 1, self.out_features))
        down = torch.stack([-CQ * cq_inv, e], dim=-2).unsqueeze(-1)
        self._rank_update(self._vectors, down, rows.mT)

        # The slot becomes free: its rows and columns are 0 by definition, not by cancellation.
        free = torch.where(excess.unsqueeze(-1), i, self.slot.unsqueeze(-1))
        self._moments.scatter_(-1, free[..., None, None].expand(*self.batch_shape, 3, M, 1), 0.0)
        self._moments.scatter_(-2, free[..., None, None].expand(*self.batch_shape, 3, 1, M), 0.0)
        self._vectors.scatter_(
            -2, free[..., None, None].expand(*self.batch_shape, 2, 1, self.out_features), 0.0
        )
        self.active.scatter_(-1, free, 0.0)
        self.slot.copy_(free.squeeze(-1))

    # -- pieces ---------------------------------------------------------------------------------

    @property
    def _normalizing(self) -> bool:
        return self._n_samples <= self.normalize_for and self.input_scale is not None

    def _normalized(self, x: Tensor) -> Tensor:
        return x if self.input_scale is None else self.input_scale(x)

    def _output_variance(self, v: Tensor) -> Tensor:
        v = v.clamp_min(0.0).unsqueeze(-1)
        if self.output_scale is None:
            return v.expand(*v.shape[:-1], self.out_features)
        return v * self.output_scale.scale.square()

    def _shared_noise(self) -> Tensor:
        """Noise by which the gain is computed: geometric mean over the (normalised) outputs."""
        return self.log_noise_variance.mean(-1).exp()

    def _cross(self, z: Tensor) -> Tensor:
        return self.kernel.vector(z, self.basis) * self.active

    def _cross_with_gradient(self, z: Tensor) -> tuple[Tensor, Tensor]:
        k, dk = self.kernel.with_gradient(z, self.basis)
        return k * self.active, dk * self.active.unsqueeze(-1)

    def _gram(self) -> Tensor:
        """K(X, X) with the nugget; the identity at free slots."""
        on = self.active.unsqueeze(-1)
        diagonal = self.kernel.diagonal(self.basis) * (1.0 + self.jitter)
        K = self.kernel(self.basis, self.basis) * on * on.mT
        K = 0.5 * (K + K.mT)
        K.diagonal(dim1=-2, dim2=-1).copy_(torch.where(self.active > 0, diagonal, 1.0))
        return K

    def _action_features(self, s: Tensor) -> tuple[Tensor, Tensor]:
        if not isinstance(self.kernel, ActionLinearKernel):
            raise ParameterError(
                "kernel", type(self.kernel).__name__, "an ActionLinearKernel for this method"
            )
        n_s = self.kernel.state_features
        s = self._cast(s)
        if s.shape[-1:] != (n_s,):
            raise ShapeError("s", f"(*any, {n_s})", s.shape)
        if self.input_scale is not None:
            s = (s - self.input_scale.shift[..., :n_s]) / self.input_scale.scale[..., :n_s]
        B = self.kernel.action_features_of(s, self.basis) * self.active.unsqueeze(-1)
        return B, self.kernel.action_prior(s)

    @staticmethod
    def _rank_update(target: Tensor, left: Tensor, right: Tensor) -> None:
        """target += left right', in place, over all leading axes at once."""
        flat = (-1, *target.shape[-2:])
        target.view(flat).baddbmm_(left.flatten(0, -3), right.flatten(0, -3).mT)

    @staticmethod
    def _any(flag: Tensor) -> bool:
        """Skip work that no model needs where looking is free: on the CPU, outside a compiled graph."""
        return flag.is_cuda or torch.compiler.is_compiling() or bool(flag.any())

    def get_extra_state(self) -> dict[str, Any]:
        """Number of samples seen: the rhythm of rebuilds continues after a reload."""
        return {"n_samples": self._n_samples}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self._n_samples = int(state["n_samples"])
