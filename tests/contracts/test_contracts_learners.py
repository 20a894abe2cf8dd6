"""Every learner keeps the contract, in both precisions and all query shapes; broken ones are caught."""

import dataclasses
import re
import sys
import types
from pathlib import Path

import pytest
import torch

import torch_ekm
from torch_ekm.residual import (
    ActionLinearKernel,
    CalibrateNoise,
    DeepKernel,
    DeepKernelSOGP,
    DetectChanges,
    ForgettingFactor,
    LearnHyperparameters,
    LinearKernel,
    MixtureResidual,
    ProcessNoise,
    RandomFeatureRLS,
    RecursiveLeastSquares,
    ReplayMLP,
    RobustWeight,
    SparseOnlineGP,
    SquaredExponential,
    Standardize,
    ZeroResidual,
    default_learner,
)
from torch_ekm.testing import check_residual_learner

pytestmark = pytest.mark.usefixtures("unchecked")  # the contract gives input that annotations forbid


def deep(dtype=torch.float64, **options):
    base = SquaredExponential(3, batch_shape=options.get("batch_shape", ()))
    options = {"parts": [Standardize(), LearnHyperparameters()], "refresh_every": 4, **options}
    return SparseOnlineGP(3, 2, capacity=6, kernel=DeepKernel(base, hidden=(8,)), dtype=dtype, **options)


def sogp(**options):
    return SparseOnlineGP(3, 2, **{"capacity": 6, **options})


LEARNERS = {
    "zero": lambda **o: ZeroResidual(3, 2, **o),
    "rls": lambda **o: RecursiveLeastSquares(3, 2, forgetting_factor=0.99, robust=3.0, **o),
    "rff": lambda **o: RandomFeatureRLS(3, 2, n_frequencies=20, **o),
    "mlp": lambda **o: ReplayMLP(3, 2, hidden=(8,), **o),
    "ensemble": lambda **o: ReplayMLP(3, 2, hidden=(8,), members=3, **o),
    "sogp": sogp,
    "default": lambda **o: default_learner(3, 2, capacity=6, **o),
    "linear": lambda **o: SparseOnlineGP(3, 2, capacity=6, kernel=LinearKernel(3), **o),
    "rls_as_given": lambda **o: RecursiveLeastSquares(3, 2, standardize=False, **o),
    "sogp_all": lambda **o: sogp(
        refresh_every=4,
        parts=[
            RobustWeight(3.0),
            CalibrateNoise(),
            DetectChanges(),
            ForgettingFactor(0.99),
            Standardize(),
            LearnHyperparameters(memory=20),
        ],
        **o,
    ),
    "sogp_skip": lambda **o: sogp(on_invalid="skip", **o),
    "sogp_action": lambda **o: sogp(kernel=ActionLinearKernel(3, 1), parts=[Standardize()], **o),
    "sogp_process_noise": lambda **o: sogp(parts=[ProcessNoise(0.01)], refresh_every=4, **o),
    "mixture": lambda **o: MixtureResidual(sogp(parts=[RobustWeight(3.0), ProcessNoise(0.003)], **o)),
    "mixture_of_two": lambda **o: MixtureResidual(
        [sogp(parts=[ProcessNoise(0.01)], **o), RecursiveLeastSquares(3, 2, **o)], levels=(0.0, 0.1)
    ),
    "deep": deep,
    "deep_sogp": lambda **o: DeepKernelSOGP(3, 2, capacity=6, hidden=(8,), refresh_every=4, **o),
}
FLEETS = ("zero", "rls", "rff", "sogp", "sogp_all", "sogp_process_noise", "mixture_of_two", "deep")


@pytest.mark.parametrize("name", LEARNERS)
def test_contract(name):
    # a single network cannot tell its own error from noise; the default learner is three in one
    n_samples = 10 if name == "default" else 12  # twice the capacity of the others
    check_residual_learner(LEARNERS[name], n_samples=n_samples, separates_noise=name != "mlp")


@pytest.mark.parametrize(  # shapes are those of one base class: two learners show the others
    ("name", "shape"),
    [
        *((name, (2, 3)) for name in FLEETS),
        *((name, n) for name in ("rls", "sogp_all") for n in ((1,), (5,))),
    ],
)
def test_contract_of_fleets(name, shape):
    check_residual_learner(
        lambda **o: LEARNERS[name](batch_shape=shape, **o), dtypes=(torch.float64,), n_samples=12
    )


def test_contract_of_river():
    from torch_ekm.interop import RiverResidual

    options = {"differentiable": False, "separates_noise": False, "has_state": False}
    check_residual_learner(lambda **o: RiverResidual(3, 2, **o), n_samples=12, **options)


def test_the_learner_of_the_docs_uses_public_names_only(monkeypatch, tmp_path):
    text = _page("write_a_learner")
    blocks = re.findall(r"^```\{code-block\} python\n:class: skip\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    (block,) = [one for one in blocks if "class Offset" in one]
    assert not re.search(r"\b_[a-z]", block)
    assert len(block.split("class Offset")[1].split("\n\n\n")[0].splitlines()) <= 22
    module = types.ModuleType("of_the_docs")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # a class is pickled by its module's name
    monkeypatch.chdir(tmp_path)
    for block in blocks:
        exec(compile(block, "write_a_learner.md", "exec"), vars(module))
    assert type(vars(module)["learner"]).__name__ == "Offset"


def test_the_decision_table_names_learners_that_can_be_made():
    calls = re.findall(r"^\| [^|]* \| `([A-Za-z_]\w*\(d, m.*?\))`", _page("choose_a_learner"), re.MULTILINE)
    assert len(calls) >= 8
    for call in calls:
        names = {**vars(torch_ekm.residual), **vars(torch_ekm), "d": 4, "m": 2, "n_actions": 2, "n": 3}
        made = eval(call, names)
        assert (made.in_features, made.out_features) == (4, 2), call


def _page(name):
    page = Path(__file__).parents[2] / "docs" / "how_to" / f"{name}.md"
    return page.read_text(encoding="utf-8")


class _WrongPrior(RecursiveLeastSquares):
    def forward(self, x):
        return super().forward(x) + 1e-12


class _NoGradient(RecursiveLeastSquares):
    def forward(self, x):
        return super().forward(x).detach()


class _WrongSlope(RecursiveLeastSquares):
    def linearize(self, x):
        mean, slope = super().linearize(x)
        return mean, slope * (1 + 1e-6)


class _StateOutside(RecursiveLeastSquares):
    def absorb(self, x, y, mask):
        self.extra = getattr(self, "extra", 0.0) + float(y.sum())
        return super().absorb(x, y, mask)

    def _mean(self, z):
        return super()._mean(z) + getattr(self, "extra", 0.0)

    def predict(self, x, *, observation=False):
        return torch.distributions.Normal(self(x), super().predict(x, observation=observation).stddev)


class _Modal(RecursiveLeastSquares):
    def forward(self, x):
        return super().forward(x) * (1.0 if self.training else 0.9)


class _Leaky(RecursiveLeastSquares):
    def _refuse(self, x, y, mask, n_time):
        self.target += 1e-3
        return super()._refuse(x, y, mask, n_time)


class _LearnsWithoutSample(RecursiveLeastSquares):
    def absorb(self, x, y, mask):
        return super().absorb(x, y, None if mask is not None and bool(mask.any()) else mask)


class _LeaksBetweenModels(RecursiveLeastSquares):
    def absorb(self, x, y, mask):
        report = super().absorb(x, y, mask)
        self.weights.copy_(0.999 * self.weights + 0.001 * self.weights.roll(1, 0))
        return report


class _IgnoresObservation(RecursiveLeastSquares):
    def predict(self, x, *, observation=False):
        return super().predict(x)


class _ReportsNaN(RecursiveLeastSquares):
    def absorb(self, x, y, mask):
        report = super().absorb(x, y, mask)
        return dataclasses.replace(report, novelty=report.novelty * torch.nan)


class _LearnsWhatItSkips(RecursiveLeastSquares):
    def _refuse(self, x, y, mask, n_time):
        if self.on_invalid == "skip":
            x.nan_to_num_(0.5)
            return mask
        return super()._refuse(x, y, mask, n_time)


class _OverwritesInputs(RecursiveLeastSquares):
    def absorb(self, x, y, mask):
        report = super().absorb(x, y, mask)
        y.mul_(0.5)
        return report


class _RemembersDeviations(RecursiveLeastSquares):
    def reset(self):
        covariance = self.covariance.clone()
        super().reset()
        self.covariance.copy_(covariance)


BROKEN = {
    "prior": _WrongPrior,
    "no gradient of forward": _NoGradient,
    "linearize": _WrongSlope,
    "state_dict": _StateOutside,
    "train": _Modal,
    "refused": _Leaky,
    "accepts other samples": _LearnsWithoutSample,
    "without a sample": _LeaksBetweenModels,
    "observation": _IgnoresObservation,
    "report.novelty": _ReportsNaN,
    "skipped": _LearnsWhatItSkips,
    "caller": _OverwritesInputs,
    "reset": _RemembersDeviations,
}


@pytest.mark.parametrize("clause", BROKEN)
def test_a_broken_learner_is_caught(clause):
    with pytest.raises(AssertionError, match=clause):
        check_residual_learner(lambda **o: BROKEN[clause](3, 2, batch_shape=(3,), **o))


def test_a_learner_in_the_place_of_its_factory_is_refused():
    with pytest.raises(
        torch_ekm.exceptions.ParameterError, match=r"a factory: lambda.*RecursiveLeastSquares"
    ):
        check_residual_learner(RecursiveLeastSquares(3, 2))
