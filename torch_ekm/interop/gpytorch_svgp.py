"""GPyTorch's streaming variational GP behind the contract (extra ``peers``)."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from .._checks import check_count, check_positive
from .._extras import require
from ..typing import Tensor
from .gpytorch_learner import GPyTorchLearner


class GPyTorchSVGP(GPyTorchLearner):
    """GPyTorch's variational GP on inducing points, ``steps`` Adam steps on each sample and a replay.

    Independent outputs share inducing points that start as the first distinct samples. The bound's data
    term is scaled to the number of samples seen.

    Args:
        inducing: number of inducing points.
        rate, minibatch, memory, steps: of Adam and of the replay.
        seed: of the minibatches.
        options: see ResidualLearner (``batch_shape`` must be (); several: ``LearnerFleet``).
    """

    _options: ClassVar[tuple[str, ...]] = ("inducing", "rate", "minibatch", "memory", "steps", "seed")

    def __init__(
        self,
        in_features: int,
        out_features: int,
        *,
        inducing: int = 100,
        rate: float = 0.01,
        minibatch: int = 1,
        memory: int = 1,
        steps: int = 1,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(in_features, out_features, **options)
        self.inducing, self.seed = check_count("inducing", inducing), int(seed)
        self.rate, self.steps = check_positive("rate", rate), check_count("steps", steps)
        self.minibatch, self.memory = check_count("minibatch", minibatch), check_count("memory", memory)
        self._start(self.memory)

    def _build(self) -> tuple[Any, ...]:
        gpytorch = require("gpytorch")
        m, d = self.out_features, self.in_features
        generator = torch.Generator().manual_seed(self.seed)
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
        return model, likelihood, torch.optim.Adam(parameters, lr=self.rate)

    def _moments(self, x: Tensor) -> tuple[Tensor, Tensor]:
        law = self._peer[0](x)
        return law.mean, law.stddev.square()

    def _noise(self) -> Tensor:
        return self._peer[1].task_noises

    def _learn(self, place: int) -> None:
        model, likelihood, optimizer = self._peer
        objective = require("gpytorch").mlls.VariationalELBO(likelihood, model, num_data=self._count)
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self._count - 1)
        model.train()
        for _ in range(self.steps):
            index = torch.randint(min(self._count, self.memory), (self.minibatch,), generator=generator)
            index[0] = place
            with torch.enable_grad():
                optimizer.zero_grad()
                loss = -objective(model(self.inputs[index]), self.targets[index])
                loss.backward()
            optimizer.step()
        model.eval()

    def _settle(self) -> None:
        model, _, optimizer = self._peer
        model.eval()
        optimizer.load_state_dict(optimizer.state_dict())  # casts its averages
