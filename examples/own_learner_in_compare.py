"""A learner of one's own compared with those of the package, on a stream.

    python examples/own_learner_in_compare.py

The report goes to the folder "comparison".
"""

import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

from torch_ekm import RecursiveLeastSquares, ResidualLearner, SparseOnlineGP
from torch_ekm.experiments import compare
from torch_ekm.residual import UpdateReport
from torch_ekm.testing import check_residual_learner


class KernelAverage(ResidualLearner):
    """g(x) = sum_i k_i y_i / (0.1 + sum_i k_i) over the last 200 samples, k_i = exp(-|x - x_i|^2 / 2 l^2)."""

    def __init__(self, in_features: int, out_features: int, *, lengthscale: float = 0.3, **options) -> None:
        super().__init__(in_features, out_features, **options)
        shape = (*self.batch_shape, 200, in_features + out_features + 1)  # rows (x, y, 1); 0: no sample yet
        self.memory = nn.Buffer(torch.zeros(shape, dtype=self.dtype, device=self.device))
        self.lengthscale = lengthscale

    def forward(self, x):
        away = (self.check_query(x).unsqueeze(-2) - self.memory[..., : self.in_features]) / self.lengthscale
        k = self.memory[..., -1] * torch.exp(-0.5 * away.square().sum(-1))
        mean = (k.unsqueeze(-1) * self.memory[..., self.in_features : -1]).sum(-2)
        return mean / (0.1 + k.sum(-1, keepdim=True))

    def predict(self, x, *, observation=False):
        mean = self(x)
        return Normal(mean, torch.full_like(mean, 0.4 if observation else 0.3), validate_args=False)

    def absorb(self, x, y, mask):
        law = self.predict(x, observation=True)
        row = torch.cat([x, y, torch.ones_like(x[..., :1])], dim=-1).unsqueeze(-2)
        memory = torch.cat([self.memory[..., 1:, :], row], dim=-2)
        self.memory.copy_(memory if mask is None else torch.where(mask[..., None, None], memory, self.memory))
        return UpdateReport.of(((y - law.mean) / law.stddev).square().mean(-1), mask)


if __name__ == "__main__":
    check_residual_learner(lambda **options: KernelAverage(3, 2, **options))  # the contract, clause by clause
    draw = np.random.default_rng(0)
    x = draw.uniform(-2, 2, (400, 2))
    y = np.sin(2 * x[:, 0]) * x[:, 1] + 0.05 * draw.normal(size=400)
    np.savetxt("stream.csv", np.column_stack([x, y]), delimiter=",", header="x1,x2,y", comments="")
    learners = {
        "sparse GP": lambda d, m: SparseOnlineGP(d, m, capacity=50),
        "least squares": RecursiveLeastSquares,
        "kernel average": KernelAverage,
    }
    report = compare("stream.csv", learners)
    print(report)
    report.write("comparison")
