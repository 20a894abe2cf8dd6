"""What is exported says what torch says, to 1e-12."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.func import jacrev, vmap

from torch_ekm import (
    DeepKernelSOGP,
    LearnHyperparameters,
    MixtureResidual,
    ProcessNoise,
    ResidualLearner,
    RobustWeight,
    SparseOnlineGP,
    Standardize,
    default_learner,
)
from torch_ekm.exceptions import ParameterError, StateError
from torch_ekm.interop import to_casadi
from torch_ekm.residual import (
    ActionLinearKernel,
    DeepKernel,
    LinearKernel,
    Matern32,
    RecursiveLeastSquares,
    SquaredExponential,
)


def deep(d: int = 3, m: int = 2) -> SparseOnlineGP:
    parts = [RobustWeight(3.0), Standardize()]
    return DeepKernelSOGP(d, m, capacity=12, hidden=(8, 8), features=3, parts=parts)


def wandering(d: int = 3, m: int = 2) -> SparseOnlineGP:
    parts = [RobustWeight(3.0), ProcessNoise(0.003), Standardize(), LearnHyperparameters()]
    return SparseOnlineGP(d, m, capacity=12, parts=parts)


LEARNERS = {
    "plain": lambda: SparseOnlineGP(3, 2, capacity=15),
    "matern32": lambda: SparseOnlineGP(3, 2, capacity=12, kernel=Matern32(3), parts=[Standardize()]),
    "action-linear": lambda: SparseOnlineGP(3, 2, capacity=12, kernel=ActionLinearKernel(3, 1)),
    "linear": lambda: SparseOnlineGP(3, 2, capacity=12, kernel=LinearKernel(3, slope_variance=2.0)),
    "squared exponential": lambda: SparseOnlineGP(3, 2, capacity=12, kernel=SquaredExponential(3)),
    "deep": deep,
    "default": lambda: default_learner(3, 2, capacity=12),
    "mixture": lambda: MixtureResidual([deep(), wandering()]),
}


def trained(name: str, n: int = 120) -> ResidualLearner:
    torch.manual_seed(0)
    learner = LEARNERS[name]()
    learn(learner, n)
    return learner


def learn(learner: ResidualLearner, n: int) -> None:
    x = 2.0 * torch.rand(n, 3, dtype=torch.float64) - 1.0
    y = torch.stack([torch.sin(2 * x.sum(-1)), x[:, 0] * x[:, 2]], dim=-1)
    learner.update(x, y + 0.02 * torch.randn_like(y))


def queries(n: int = 9) -> torch.Tensor:
    return 2.4 * torch.rand(n, 3, dtype=torch.float64) - 1.2


def close(name: str, ours: torch.Tensor | np.ndarray, truth: torch.Tensor) -> None:
    torch.testing.assert_close(
        torch.as_tensor(ours), truth, rtol=1e-12, atol=1e-12, msg=lambda m: f"{name}: {m}"
    )


def test_jacobians_of_a_mixture_are_those_of_autograd() -> None:
    learner, x = trained("mixture"), queries(40)
    prediction = learner.predict_with_jacobians(x)
    law = learner.predict(x)
    torch.testing.assert_close(prediction.mean, law.mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(prediction.variance, law.variance, rtol=1e-10, atol=1e-12)
    for field, moment in (("mean_jacobian", "mean"), ("variance_jacobian", "variance")):
        slope = vmap(jacrev(lambda one, moment=moment: getattr(learner.predict(one), moment)))(x)
        torch.testing.assert_close(getattr(prediction, field), slope, rtol=1e-8, atol=1e-9)


class Frozen(nn.Module):
    """As docs/how_to/qp_or_mpc.md writes it."""

    def __init__(self, learner: ResidualLearner) -> None:
        super().__init__()
        self.learner = learner

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return tuple(self.learner.predict_with_jacobians(x))


@pytest.mark.parametrize(("name", "format"), [("plain", "pt2"), ("mixture", "onnx")])
def test_a_learner_that_torch_exports_says_the_same(name: str, format: str, tmp_path: Path) -> None:
    learner, example = trained(name), (torch.zeros(2, 3, dtype=torch.float64),)
    rows = {"x": {0: torch.export.Dim("n", min=1)}}
    with torch.no_grad():
        program = torch.export.export(Frozen(learner).eval(), example, dynamic_shapes=rows, strict=False)
    if format == "onnx":
        pytest.importorskip("onnxscript", reason="extra 'interop'")
        onnxruntime = pytest.importorskip("onnxruntime", reason="extra 'interop'")
        path = str(tmp_path / "learner.onnx")
        torch.onnx.export(program, example, dynamo=True, verbose=False).save(path)
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])

        def run(x: torch.Tensor) -> list:
            return session.run(None, {session.get_inputs()[0].name: x.numpy()})
    else:
        torch.export.save(program, tmp_path / "learner.pt2")
        run = torch.export.load(tmp_path / "learner.pt2").module()
    for n in (1, 9):
        x = queries(n)
        truth = learner.predict_with_jacobians(x)
        for field, ours in zip(truth._fields, run(x), strict=True):
            close(field, ours, getattr(truth, field))


def test_a_mixture_names_a_learner_without_jacobians() -> None:
    with pytest.raises(ParameterError, match="RecursiveLeastSquares"):
        MixtureResidual(RecursiveLeastSquares(3, 2)).predict_with_jacobians(torch.zeros(3))


@pytest.mark.parametrize("name", LEARNERS)
def test_casadi_says_the_same_while_it_learns(name: str) -> None:
    learner = trained(name)
    g = to_casadi(learner)
    function = g.function
    for _ in range(2):
        x = queries()
        truth = learner.predict_with_jacobians(x)
        for row in range(len(x)):
            mean, jacobian = g(x[row].numpy())
            close("mean", mean, truth.mean[row])
            close("jacobian", jacobian, truth.mean_jacobian[row])
        learn(learner, 40)  # basis, coefficients, hyperparameters and units move; the function stays
    assert g.function is function
    assert g.parameters().shape == (g.n_parameters,)


class Flat(SquaredExponential):
    """No subclass counts as its base."""

    def phi(self, d2: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(d2)


def test_casadi_names_what_it_cannot_say() -> None:
    kernel = DeepKernel(Flat(1), hidden=(2,), features=1)
    with pytest.raises(ParameterError, match=r"Flat.*no subclass"):
        to_casadi(SparseOnlineGP(1, 1, kernel=kernel))
    with pytest.raises(ParameterError, match="RecursiveLeastSquares"):
        to_casadi(RecursiveLeastSquares(3, 2))
    with pytest.raises(StateError, match="one model"):
        to_casadi(SparseOnlineGP(3, 2, batch_shape=(2,)))
