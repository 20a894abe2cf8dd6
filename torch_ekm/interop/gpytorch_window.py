"""GPyTorch's exact GP on a sliding window behind the contract (extra ``peers``)."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from .._checks import check_count, check_positive
from .._extras import require
from ..typing import Tensor
from .gpytorch_learner import GPyTorchLearner


class GPyTorchWindow(GPyTorchLearner):
    """An exact GP of GPyTorch on the last ``window`` samples, its hyperparameters refitted now and then.

    Outputs share kernel and noise. Every ``refit_every`` samples ``steps`` Adam steps climb the marginal
    likelihood of the window.

    Args:
        window: samples kept.
        refit_every, steps, rate: of the fit.
        noise_variance: at the start.
        options: see ResidualLearner (``batch_shape`` must be (); several: ``LearnerFleet``).
    """

    _options: ClassVar[tuple[str, ...]] = ("window", "refit_every", "steps", "rate", "noise_variance")

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        window: int = 100,
        refit_every: int = 50,
        steps: int = 20,
        rate: float = 0.05,
        noise_variance: float = 0.01,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.window, self.steps = check_count("window", window), check_count("steps", steps)
        self.refit_every = check_count("refit_every", refit_every)
        self.rate = check_positive("rate", rate)
        self.noise_variance = check_positive("noise_variance", noise_variance)
        self._start(self.window)

    def _build(self) -> tuple[Any, ...]:
        gpytorch = require("gpytorch")
        d, tasks = self.in_features, torch.Size([self.out_features])

        class Model(gpytorch.models.ExactGP):
            def __init__(self, likelihood) -> None:
                super().__init__(None, None, likelihood)
                self.kernel = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=d))
                self.kernel.base_kernel.lengthscale = d**0.5
                self.kernel.outputscale = 1.0

            def forward(self, x):
                zero = torch.zeros(*tasks, x.shape[-2], dtype=x.dtype, device=x.device)
                return gpytorch.distributions.MultivariateNormal(zero, self.kernel(x))

        likelihood = gpytorch.likelihoods.GaussianLikelihood().to(self._like)
        likelihood.noise = self.noise_variance
        return (Model(likelihood).to(self._like),)

    def _settle(self) -> None:
        """Condition the model on the window."""
        (model,), n = self._peer, min(self._count, self.window)
        if n:
            data = self.inputs[:n].expand(self.out_features, n, -1), self.targets[:n].mT.contiguous()
            model.set_train_data(*data, strict=False)
        model.eval()

    def _moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        (model,) = self._peer
        if self._count == 0:
            mean = (0.0 * x[:, :1]).expand(-1, self.out_features)
            return mean, model.kernel(x, diag=True).unsqueeze(-1).expand_as(mean)
        law = model(x.expand(self.out_features, *x.shape))
        return law.mean.mT, law.variance.mT

    def _noise(self) -> Tensor:
        return self._peer[0].likelihood.noise

    def _learn(self, place: int) -> None:
        self._settle()
        if self._count % self.refit_every == 0:
            self._refit()

    def _refit(self) -> None:
        (model,) = self._peer
        model.train()
        optimizer = torch.optim.Adam(model.parameters(), lr=self.rate)
        objective = require("gpytorch").mlls.ExactMarginalLogLikelihood(model.likelihood, model)
        for _ in range(self.steps):
            with torch.enable_grad():
                optimizer.zero_grad()
                loss = -objective(model(*model.train_inputs), model.train_targets).sum()
                loss.backward()
            optimizer.step()
        self._settle()
