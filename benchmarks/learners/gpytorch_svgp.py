"""GPyTorch's streaming variational GP behind the contract of learners, to be compared with."""

from __future__ import annotations

from typing import Any

import gpytorch
import torch
from torch import nn
from torch.distributions import Normal

from torch_ekm.residual.base import SingleLearner
from torch_ekm.residual.report import UpdateReport
from torch_ekm.typing import Tensor

_RATE = 0.01  # of Adam


class GPyTorchSVGP(SingleLearner):
    """GPyTorch's variational GP on inducing points, an Adam step on each sample.

    Independent outputs share inducing points that start as the first distinct samples. The bound's data
    term is scaled to the number of samples seen. GPyTorch's state lies partly outside of state dicts: the
    model is no submodule, and is not saved.

    Args:
        inducing: number of inducing points.
        options: see ResidualLearner (``batch_shape`` must be ()).
    """

    def __init__(self, in_features: int, out_features: int, *, inducing: int = 100, **options: Any) -> None:
        super().__init__(in_features, out_features, **options)
        self.inducing = inducing
        self.reset()

    def _build(self) -> tuple[Any, ...]:
        """All that has a state dict: model, likelihood, optimizer."""
        m, d = self.out_features, self.in_features
        generator = torch.Generator().manual_seed(0)
        points = torch.randn(self.inducing, d, generator=generator, dtype=torch.float64).to(self._like)

        class Model(gpytorch.models.ApproximateGP):
            def __init__(self) -> None:
                v = gpytorch.variational
                # by default the mean starts at random, of the order of 1e-3
                q = v.CholeskyVariationalDistribution(len(points), torch.Size([m]), mean_init_std=0.0)
                inner = v.VariationalStrategy(self, points, q, learn_inducing_locations=True)
                super().__init__(v.IndependentMultitaskVariationalStrategy(inner, num_tasks=m))
                self.mean_module = gpytorch.means.ZeroMean()
                self.covar_module = gpytorch.kernels.ScaleKernel(gpytorch.kernels.RBFKernel(ard_num_dims=d))
                self.covar_module.base_kernel.lengthscale = d**0.5
                self.covar_module.outputscale = 1.0

            def forward(self, x):
                return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

        model = Model().to(self._like)
        likelihood = gpytorch.likelihoods.MultitaskGaussianLikelihood(num_tasks=m, has_global_noise=False)
        likelihood = likelihood.to(self._like)
        likelihood.task_noises = torch.full((m,), 0.01)
        parameters = [*model.parameters(), *likelihood.parameters()]
        return model, likelihood, torch.optim.Adam(parameters, lr=_RATE)

    def _learn(self, x: Tensor, y: Tensor) -> None:
        model, likelihood, optimizer = self._peer
        self._count += 1
        objective = gpytorch.mlls.VariationalELBO(likelihood, model, num_data=self._count)
        model.train()
        with torch.enable_grad():
            optimizer.zero_grad()
            loss = -objective(model(x[None]), y[None])
            loss.backward()
        optimizer.step()
        model.eval()

    def _settle(self) -> None:
        """The model or its dtype changed."""
        model, _, optimizer = self._peer
        model.eval()
        optimizer.load_state_dict(optimizer.state_dict())  # casts its averages

    def reset(self) -> None:
        """A new model."""
        super().reset()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self._count, self._peer = 0, self._build()
            self._settle()

    def _shaped(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of g."""
        x = self.check_query(x)
        law = self._peer[0](x.reshape(-1, self.in_features))
        shape = (*x.shape[:-1], self.out_features)
        return law.mean.reshape(shape), law.stddev.square().clamp_min(1e-12).reshape(shape)

    def forward(self, x: Tensor) -> Tensor:
        """The posterior mean."""
        return self._shaped(x)[0]

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The posterior law, plus noise on request."""
        with torch.no_grad():
            mean, variance = self._shaped(x)
            variance = variance + self._peer[1].task_noises if observation else variance
        return Normal(mean, variance.sqrt(), validate_args=False)

    def absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        law = self.predict(x, observation=True)
        self._learn(x, y)
        return UpdateReport.of(((y - law.mean) / law.stddev).square().mean(-1), mask)

    def _apply(self, fn, recurse=True):
        super()._apply(fn, recurse)
        for part in self._peer:
            if isinstance(part, nn.Module):
                part._apply(fn)
        self._settle()
        return self
