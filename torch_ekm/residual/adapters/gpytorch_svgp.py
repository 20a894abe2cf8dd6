"""GPyTorch's streaming variational GP behind the contract (extra ``peers``)."""

from __future__ import annotations

import io
from typing import Any, ClassVar

import torch
from torch import nn
from torch.distributions import Normal

from ..._extras import require
from ...typing import Tensor
from ..checks import check_count, check_positive
from ..report import UpdateReport
from .rebuilt import Rebuilt


class GPyTorchSVGP(Rebuilt):
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
    _model: Any
    _likelihood: Any
    _optimizer: Any

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
        require("gpytorch")
        self.inducing, self.seed = check_count("inducing", inducing), int(seed)
        self.rate, self.steps = check_positive("rate", rate), check_count("steps", steps)
        self.minibatch, self.memory = check_count("minibatch", minibatch), check_count("memory", memory)
        self.inputs = nn.Buffer(self._like.new_zeros(self.memory, self.in_features))
        self.targets = nn.Buffer(self._like.new_zeros(self.memory, self.out_features))
        self.reset()

    def _build(self) -> None:
        gpytorch = require("gpytorch")
        m, d = self.out_features, self.in_features
        generator = torch.Generator().manual_seed(self.seed)
        points = torch.randn(self.inducing, d, generator=generator, dtype=torch.float64).to(self._like)

        class Model(gpytorch.models.ApproximateGP):
            def __init__(self) -> None:
                v = gpytorch.variational
                q = v.CholeskyVariationalDistribution(
                    len(points),
                    torch.Size([m]),
                    mean_init_std=0.0,  # default: a random mean of 1e-3
                )
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
        # plain attributes: GPyTorch's state lives partly outside its state dict, so it travels pickled
        object.__setattr__(self, "_model", model)
        object.__setattr__(self, "_likelihood", likelihood)
        parameters = [*model.parameters(), *likelihood.parameters()]
        object.__setattr__(self, "_optimizer", torch.optim.Adam(parameters, lr=self.rate))

    def reset(self) -> None:
        """A new model."""
        self._count = 0
        self._build()
        self.inputs.zero_()
        self.targets.zero_()
        self.n_refused.zero_()

    def _law(self, x: Tensor) -> Normal:
        self._model.eval()
        flat = x.reshape(-1, self.in_features)
        law = self._model(flat)
        shape = (*x.shape[:-1], self.out_features)
        return Normal(law.mean.reshape(shape), law.variance.clamp_min(1e-12).sqrt().reshape(shape), False)

    def forward(self, x: Tensor) -> Tensor:
        """The variational mean; 0 before the first sample."""
        return self._law(self._check_query(x)).mean

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The variational law, plus the likelihood's noise on request."""
        with torch.no_grad():
            law = self._law(self._check_query(x))
            if not observation:
                return law
            return Normal(law.mean, (law.variance + self._likelihood.task_noises).sqrt(), validate_args=False)

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        law = self.predict(x, observation=True)
        nis = ((y - law.mean) / law.stddev).square().mean(-1)
        n = self._count
        self.inputs[n % self.memory], self.targets[n % self.memory] = x, y
        self._count += 1
        gpytorch = require("gpytorch")
        objective = gpytorch.mlls.VariationalELBO(self._likelihood, self._model, num_data=self._count)
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + n)
        self._model.train()
        for _ in range(self.steps):
            index = torch.randint(min(n + 1, self.memory), (self.minibatch,), generator=generator)
            index[0] = n % self.memory
            with torch.enable_grad():
                self._optimizer.zero_grad()
                loss = -objective(self._model(self.inputs[index]), self.targets[index])
                loss.backward()
            self._optimizer.step()
        self._model.eval()
        return self._absorbed(nis)

    def get_extra_state(self) -> Tensor:
        """State dicts of model, likelihood and optimiser."""
        file = io.BytesIO()
        parts = (self._model, self._likelihood, self._optimizer)
        torch.save((self._count, *(p.state_dict() for p in parts)), file)
        return torch.frombuffer(bytearray(file.getvalue()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """See get_extra_state."""
        file = io.BytesIO(bytes(state.tolist()))
        self._count, model, likelihood, optimizer = torch.load(file, weights_only=True)
        self._build()
        for part, values in zip(
            (self._model, self._likelihood, self._optimizer), (model, likelihood, optimizer), strict=True
        ):
            part.load_state_dict(values)

    def _apply(self, fn, recurse=True):
        super()._apply(fn, recurse)
        if "_model" in self.__dict__:
            self._model._apply(fn, recurse)
            self._likelihood._apply(fn, recurse)
            self._optimizer.load_state_dict(self._optimizer.state_dict())  # casts its averages
        return self
