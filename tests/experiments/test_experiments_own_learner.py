"""Learners of the user's own in a comparison: lambdas and local classes, in processes, resumed, refused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.distributions import Normal

from torch_ekm.exceptions import ParameterError
from torch_ekm.experiments import compare
from torch_ekm.experiments.learner_comparison.stream import Stream
from torch_ekm.residual import RecursiveLeastSquares, ResidualLearner, SparseOnlineGP


def stream(n: int = 60, name: str = "linear") -> Stream:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    y = x @ torch.tensor([[1.0, -0.5], [0.3, 0.8], [0.0, 0.4]], dtype=torch.float64)
    return Stream(name, x, y + 0.1 * torch.randn(n, 2, generator=generator, dtype=torch.float64), warm_up=10)


def damped_class(share: float) -> type[ResidualLearner]:
    """A class that no import finds, with a figure that no attribute shows."""

    class Damped(RecursiveLeastSquares):
        def predict(self, x, *, observation=False):
            law = super().predict(x, observation=observation)
            return Normal(share * law.mean, law.stddev)

    return Damped


def test_own_learners_give_the_same_in_processes(tmp_path: Path) -> None:
    damped = damped_class(0.5)
    learners: dict[str, Callable[[int, int], ResidualLearner]] = {
        "lambda": lambda d, m: RecursiveLeastSquares(d, m),
        "local/class": damped,
        "package": lambda d, m: SparseOnlineGP(d, m, capacity=20),
    }
    data = [stream(), stream(50, "short one")]
    alone = compare(data, learners)
    together = compare(data, learners, processes=2, folder=tmp_path)
    assert together.learners == ("lambda", "local/class", "package")
    for key, squared in alone.errors.items():
        np.testing.assert_array_equal(together.errors[key], squared)
    half = alone.scores["linear", "local/class"].rms.mean
    assert alone.scores["linear", "lambda"].rms.mean < 0.5 < half < 0.7
    assert len(list(tmp_path.glob("*.json"))) == 6


def test_an_own_learner_is_run_anew_when_it_changes(tmp_path: Path) -> None:
    def run(factory: Callable[[int, int], ResidualLearner]) -> tuple[float, int]:
        report = compare(stream(), {"mine": factory}, folder=tmp_path)
        return report.scores["linear", "mine"].rms.mean, len(list(tmp_path.glob("*.json")))

    first = run(lambda d, m: damped_class(0.5)(d, m))
    assert run(damped_class(0.5)) == first  # the same learner in other words
    assert run(damped_class(0.75))[1] == 2  # what its code closes over
    assert run(lambda d, m: damped_class(0.5)(d, m, noise_variance=0.4))[1] == 3  # what it is made with

    class Damped(RecursiveLeastSquares):
        def predict(self, x, *, observation=False):
            law = super().predict(x, observation=observation)
            return Normal(0.5 * law.mean, 2 * law.stddev)

    assert run(Damped)[1] == 4  # its code
    assert compare(stream(), {"other": Damped}, folder=tmp_path)
    assert len(list(tmp_path.glob("*.json"))) == 5


def test_what_makes_no_learner_is_refused_by_name_before_anything_runs(tmp_path: Path) -> None:
    def broken(d: int, m: int) -> ResidualLearner:
        raise RuntimeError("no such file")

    good = {"good": lambda d, m: RecursiveLeastSquares(d, m)}
    for factory, problem in (
        (broken, r"called with \(3, 2\) it raised RuntimeError: no such file"),
        (lambda d, m: None, "it returned a NoneType"),
        (lambda d, m: RecursiveLeastSquares(m, d), "of 2 inputs, 3 outputs"),
        (lambda d, m: RecursiveLeastSquares(d, m, batch_shape=(4,)), r"batch_shape \(4,\)"),
        (lambda d: RecursiveLeastSquares(d, 1), "it raised TypeError"),
        (RecursiveLeastSquares(3, 2), "a factory, such as RecursiveLeastSquares"),
    ):
        with pytest.raises(ParameterError, match=rf"(?s)learners\['bad'\].*{problem}"):
            compare(stream(), {**good, "bad": factory}, folder=tmp_path)
    assert not list(tmp_path.glob("*.json"))
    unnamed: list = [RecursiveLeastSquares, [RecursiveLeastSquares]]
    for learners in unnamed:
        with pytest.raises(ParameterError, match=r"names, or \{name: factory"):
            compare(stream(), learners)


def test_nothing_of_the_caller_is_left_changed() -> None:
    threads = torch.get_num_threads()
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    torch.set_num_threads(2)
    try:
        compare(stream(), {"mine": lambda d, m: RecursiveLeastSquares(d, m)})
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(torch.rand(1), expected)
