"""What a learner says: means, slopes, laws and draws of g and of y."""

from __future__ import annotations

import math
import pathlib
from abc import ABC, abstractmethod
from typing import Literal

import torch
from torch import nn
from torch.distributions import Distribution, Normal

from .._checks import check_count, check_share
from ..typing import Float, Tensor
from .derivatives import value_and_jacobian


class Predictions(nn.Module, ABC):
    """The queries of a :class:`~torch_ekm.residual.ResidualLearner`, whose docstring has their shapes."""

    in_features: int
    out_features: int
    dtype: torch.dtype
    device: torch.device

    @abstractmethod
    def check_query(self, x: Float[Tensor, "*any in_features"]) -> Float[Tensor, "*all in_features"]:
        """x in the learner's dtype, with all the fleet's axes."""

    @abstractmethod
    def forward(self, x: Float[Tensor, "*any in_features"]) -> Float[Tensor, "*all out_features"]:
        """Posterior mean E[g(x)] in the units of y, differentiable in x."""

    @abstractmethod
    def predict(self, x: Float[Tensor, "*any in_features"], *, observation: bool = False) -> Normal:
        """N(E[g(x)], Var[g(x)]), or the law of y = g(x) + noise with ``observation=True``."""

    def predictive(self, x: Float[Tensor, "*any in_features"]) -> Distribution:
        """Law of y, for log densities: ``predict`` with noise, unless a learner has a better one.

        ``log_prob(y)``, ``cdf(y)`` and ``icdf(p)`` have the shape of y. Learners of heavy-tailed noise
        override it.
        """
        return self.predict(x, observation=True)

    def quantile(self, x: Float[Tensor, "*any in_features"], p: float) -> Float[Tensor, "*all out_features"]:
        """What y stays below with probability p, of each output.

        Raises:
            ParameterError: p is not in (0, 1).
        """
        share = torch.as_tensor(check_share("p", p), dtype=self.dtype, device=self.device)
        return self.predictive(x).icdf(share)

    def interval(
        self, x: Float[Tensor, "*any in_features"], level: float = 0.9
    ) -> tuple[Float[Tensor, "*all out_features"], Float[Tensor, "*all out_features"]]:
        """Lower and upper end of what y lies in with probability ``level``, with equal tails, of each output.

        Raises:
            ParameterError: the level is not in (0, 1).
        """
        out = 0.5 - 0.5 * check_share("level", level)
        return self.quantile(x, out), self.quantile(x, 1.0 - out)

    def moments(
        self, x: Float[Tensor, "*any in_features"], *, observation: bool = False
    ) -> tuple[Float[Tensor, "*all out_features"], Float[Tensor, "*all out_features"]]:
        """Mean and variance of :meth:`predict`."""
        law = self.predict(x, observation=observation)
        return law.mean, law.variance

    @torch.no_grad()
    def sample(
        self,
        x: Float[Tensor, "*any in_features"],
        n: int = 1,
        *,
        observation: bool = False,
        generator: torch.Generator | None = None,
    ) -> Float[Tensor, "n *all out_features"]:
        """n draws of g, or of y with ``observation=True``, at all queries together.

        A draw is one function: two queries vary together as far as the learner knows how g does. Each query
        alone has the law of :meth:`predict`, or of :meth:`predictive`.

        Raises:
            ParameterError: n is no positive integer.
        """
        x = self.check_query(x)
        z = self.unit_draws(x, check_count("n", n), generator)
        mean, latent = self.moments(x)
        if not observation:
            return mean + latent.sqrt() * z
        share = (latent / self.moments(x, observation=True)[1]).clamp(0.0, 1.0)
        own = torch.randn(z.shape, generator=generator, dtype=z.dtype, device=z.device)
        return self._placed(x, share.sqrt() * z + (1.0 - share).sqrt() * own, generator)

    def unit_draws(
        self, x: Float[Tensor, "*all in_features"], n: int, generator: torch.Generator | None
    ) -> Float[Tensor, "n *all out_features"]:
        """n draws of ``(g(x) - mean) / deviation``; of a learner that knows no more, of each query alone."""
        shape = n, *x.shape[:-1], self.out_features
        return torch.randn(shape, generator=generator, dtype=x.dtype, device=x.device)

    def _placed(self, x: Tensor, z: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draws of y, from normal ones of unit variance."""
        law = self.predict(x, observation=True)
        return law.mean + law.stddev * z

    def linearize(
        self, x: Float[Tensor, "*any in_features"]
    ) -> tuple[Float[Tensor, "*all out_features"], Float[Tensor, "*all out_features in_features"]]:
        """``(g(x), dg/dx)``. Learners with a closed form override this autograd version."""
        x = self.check_query(x)
        mean, J = value_and_jacobian(self, x)
        return mean, x.new_zeros(*mean.shape, x.shape[-1]) if J is None else J

    def slope_deviation(
        self, x: Float[Tensor, "*any in_features"]
    ) -> Float[Tensor, "*all out_features in_features"]:
        """Standard deviation of each entry of ``dg/dx``: what the slope of :meth:`linearize` is worth.

        That of an input which never moved is large: nothing was seen of its slope. NaN: the learner states
        none.
        """
        x = self.check_query(x)
        return x.new_full((*x.shape[:-1], self.out_features, self.in_features), math.nan)

    def export(self, path: str | pathlib.Path, *, format: Literal["onnx", "pt2"] = "pt2") -> pathlib.Path:
        """Write what the learner predicts now to a file that other runtimes read, and return its path.

        The input is ``x (n, in)``; the outputs are ``mean`` and latent ``variance`` ``(n, out)`` and their
        derivatives ``mean_jacobian`` and ``variance_jacobian`` ``(n, out, in)``. What is learned later is
        not in the file; where the learner goes on, see :func:`torch_ekm.interop.to_casadi`.

        Args:
            path: of the file.
            format: ``"pt2"``, for ``torch.export.load`` and AOTInductor, or ``"onnx"`` (extra ``interop``).

        Raises:
            ParameterError: the learner has no closed-form Jacobians of mean and variance (a SparseOnlineGP
                or a MixtureResidual of such has), or is a fleet; or an unknown format.
            MissingExtraError: for ONNX, a package is missing.
        """
        from .export import export_learner  # torch's exporter is slow to import

        return export_learner(self, path, format)


def joint_draws(
    covariance: Float[Tensor, "*batch q q"], n: int, out: int, generator: torch.Generator | None
) -> Float[Tensor, "n q *batch out"]:
    """n normal draws with these correlations and unit variance, for each of ``out`` outputs."""
    d = covariance.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(covariance.dtype).tiny).rsqrt()
    values, vectors = torch.linalg.eigh(d.unsqueeze(-1) * covariance * d.unsqueeze(-2))
    root = vectors * values.clamp_min(0.0).sqrt().unsqueeze(-2)
    root = torch.nn.functional.normalize(root, dim=-1)  # what rounding took from the variance
    shape = n, *root.shape[:-1], out
    draws = root @ torch.randn(shape, generator=generator, dtype=root.dtype, device=root.device)
    return draws.movedim(-2, 1)
