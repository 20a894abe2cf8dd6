"""GPyTorch's exact GP on a sliding window behind the contract (extra ``peers``)."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import nn
from torch.distributions import Normal

from ..._extras import require
from ...typing import Tensor
from ..checks import check_count, check_positive
from ..report import UpdateReport
from .rebuilt import Rebuilt


class GPyTorchWindow(Rebuilt):
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
    _model: Any
    _likelihood: Any

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
        require("gpytorch")
        self.window, self.steps = check_count("window", window), check_count("steps", steps)
        self.refit_every = check_count("refit_every", refit_every)
        self.rate = check_positive("rate", rate)
        self.noise_variance = check_positive("noise_variance", noise_variance)
        self.inputs = nn.Buffer(self._like.new_zeros(self.window, self.in_features))
        self.targets = nn.Buffer(self._like.new_zeros(self.window, self.out_features))
        self.reset()

    def _build(self) -> None:
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
        # plain attributes: an exact GP keeps its data outside its state dict
        object.__setattr__(self, "_likelihood", likelihood)
        object.__setattr__(self, "_model", Model(likelihood).to(self._like))
        self._condition()

    def _condition(self) -> None:
        n = min(self._count, self.window)
        if n:
            data = self.inputs[:n].expand(self.out_features, n, -1), self.targets[:n].mT.contiguous()
            self._model.set_train_data(*data, strict=False)
        self._model.eval()
        self._likelihood.eval()

    def reset(self) -> None:
        """An empty window and hyperparameters as at the start."""
        self._count = 0
        self.inputs.zero_()
        self.targets.zero_()
        self.n_refused.zero_()
        self._build()

    def _law(self, x: Tensor) -> tuple[Tensor, Tensor]:
        flat = x.reshape(-1, self.in_features)
        if self._count == 0:
            mean = (0.0 * flat[:, :1]).expand(-1, self.out_features)
            variance = self._model.kernel(flat, diag=True).unsqueeze(-1).expand_as(mean)
        else:
            law = self._model(flat.expand(self.out_features, *flat.shape))
            mean, variance = law.mean.mT, law.variance.mT
        shape = (*x.shape[:-1], self.out_features)
        return mean.reshape(shape), variance.reshape(shape).clamp_min(1e-12)

    def forward(self, x: Tensor) -> Tensor:
        """The exact posterior mean."""
        return self._law(self._check_query(x))[0]

    def predict(self, x: Tensor, *, observation: bool = False) -> Normal:
        """The exact posterior law."""
        with torch.no_grad():
            mean, variance = self._law(self._check_query(x))
            variance = variance + self._likelihood.noise if observation else variance
        return Normal(mean, variance.sqrt(), validate_args=False)

    def _absorb(self, x: Tensor, y: Tensor, mask: Tensor | None) -> UpdateReport:
        law = self.predict(x, observation=True)
        nis = ((y - law.mean) / law.stddev).square().mean(-1)
        place = self._count % self.window
        self.inputs[place], self.targets[place] = x, y
        self._count += 1
        self._condition()
        if self._count % self.refit_every == 0:
            self._refit()
        return self._absorbed(nis)

    def _refit(self) -> None:
        gpytorch = require("gpytorch")
        self._model.train()
        self._likelihood.train()
        optimizer = torch.optim.Adam(self._model.parameters(), lr=self.rate)
        objective = gpytorch.mlls.ExactMarginalLogLikelihood(self._likelihood, self._model)
        for _ in range(self.steps):
            with torch.enable_grad():
                optimizer.zero_grad()
                law = self._model(*self._model.train_inputs)
                loss = -objective(law, self._model.train_targets).sum()
                loss.backward()
            optimizer.step()
        self._condition()

    def get_extra_state(self) -> dict[str, Any]:
        """Sample count and hyperparameters; the window is in buffers."""
        return {"count": self._count, "model": self._model.state_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See get_extra_state."""
        self._count = int(state["count"])
        self._build()
        self._model.load_state_dict(state["model"])

    def load_state_dict(self, state_dict, strict: bool = True, assign: bool = False):
        """As usual; then the model is conditioned on the loaded window."""
        result = super().load_state_dict(state_dict, strict, assign)
        self._condition()
        return result

    def _apply(self, fn, recurse=True):
        super()._apply(fn, recurse)
        if "_model" in self.__dict__:
            self._model._apply(fn)
            self._condition()
        return self
