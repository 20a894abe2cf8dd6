"""GPyTorch's streaming variational GP behind the contract of learners, to be compared with."""

from __future__ import annotations

from typing import Any

import gpytorch
import torch
from peer import Peer
from torch import nn

from torch_ekm._checks import check_count
from torch_ekm.typing import Tensor

_RATE = 0.01  # of Adam


class GPyTorchSVGP(Peer):
    """GPyTorch's variational GP on inducing points, an Adam step on each sample and a replay.

    Independent outputs share inducing points that start as the first distinct samples. The bound's data
    term is scaled to the number of samples seen. GPyTorch's state lies partly outside of state dicts: the
    model is no submodule, and is not saved.

    Args:
        inducing: number of inducing points.
        minibatch, memory: samples of a step, and those kept to draw them from.
        options: see ResidualLearner (``batch_shape`` must be ()).
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        inducing: int = 100,
        minibatch: int = 1,
        memory: int = 1,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.inducing = check_count("inducing", inducing)
        self.minibatch, self.memory = check_count("minibatch", minibatch), check_count("memory", memory)
        self.inputs = nn.Buffer(self._like.new_zeros(self.memory, self.in_features))
        self.targets = nn.Buffer(self._like.new_zeros(self.memory, self.out_features))
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
        place = self._count % len(self.inputs)
        self.inputs[place], self.targets[place] = x, y
        self._count += 1
        objective = gpytorch.mlls.VariationalELBO(likelihood, model, num_data=self._count)
        generator = torch.Generator().manual_seed(self._count - 1)
        model.train()
        index = torch.randint(min(self._count, self.memory), (self.minibatch,), generator=generator)
        index[0] = place
        with torch.enable_grad():
            optimizer.zero_grad()
            loss = -objective(model(self.inputs[index]), self.targets[index])
            loss.backward()
        optimizer.step()
        model.eval()

    def _settle(self) -> None:
        """The model or its dtype changed."""
        model, _, optimizer = self._peer
        model.eval()
        optimizer.load_state_dict(optimizer.state_dict())  # casts its averages

    def _begin(self) -> None:
        self._count = 0
        self._peer = self._build()
        self._settle()

    def _law(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        model, likelihood, _ = self._peer
        law = model(x)
        return law.mean, law.stddev.square().clamp_min(1e-12), likelihood.task_noises

    def _apply(self, fn, recurse=True):
        super()._apply(fn, recurse)
        for part in self._peer:
            if isinstance(part, nn.Module):
                part._apply(fn)
        self._settle()
        return self
