"""Comparing learners: the protocol is honest, the statistics are right, and broken files are told clearly."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ekm._terminal import print_report
from torch_ekm.exceptions import ParameterError, ShapeError
from torch_ekm.experiments import compare
from torch_ekm.experiments.learner_comparison.report import ComparisonReport, overview_table, score_table
from torch_ekm.experiments.learner_comparison.run import run_one
from torch_ekm.experiments.learner_comparison.scores import Comparison, Score, block_bootstrap
from torch_ekm.experiments.learner_comparison.stream import Stream
from torch_ekm.experiments.learners import COMPARED, LEARNERS, learner_factory
from torch_ekm.experiments.reporting.report import Report, Table

WEIGHTS = torch.tensor([[1.0, -0.5], [0.3, 0.8], [0.0, 0.4]], dtype=torch.float64)


def linear(n: int = 120, seed: int = 0, name: str = "linear") -> Stream:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    y = x @ WEIGHTS + 0.1 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    return Stream(name, x, y, warm_up=20)


@pytest.fixture(scope="module")
def compared() -> ComparisonReport:
    return compare([linear(), linear(seed=1, name="other")], ("model alone", "linear RLS", "SOGP plain"))


def test_model_alone_is_the_unit(compared: Comparison) -> None:
    estimate = compared.scores["linear", "model alone"].rms
    assert (estimate.mean, estimate.low, estimate.high) == pytest.approx((1.0, 1.0, 1.0), abs=1e-5)


def test_errors_are_those_of_predictions_made_before_learning(compared: Comparison) -> None:
    stream, learner = linear(), learner_factory("linear RLS")(3, 2)
    squared = []
    for x, y in zip(stream.x, stream.y, strict=True):
        squared.append(float((y - learner(x)).square().mean()))
        learner.update(x, y)
    np.testing.assert_allclose(compared.errors["linear", "linear RLS"], squared[20:], rtol=1e-5)
    expected = math.sqrt(np.mean(squared[20:]) / float(stream.y[20:].square().mean()))
    assert compared.scores["linear", "linear RLS"].rms.mean == pytest.approx(expected, rel=1e-5)


def test_a_linear_stream_is_won_by_the_linear_learner_and_we_say_so(compared: Comparison) -> None:
    assert compared.best("linear").learner == "linear RLS"
    sentence = compared.verdicts()[0]
    assert "linear RLS is best" in sentence
    assert re.search(r"SOGP plain has [\d.]+ \[[\d.]+, [\d.]+\] times its error", sentence)
    assert "in a hundred" not in sentence
    assert compared.ratio("linear", "SOGP plain", "linear RLS").low > 1


def test_noise_is_not_called_learned() -> None:
    noise = torch.from_numpy(np.random.default_rng(3).normal(size=(120, 2)))
    said = compare(dataclasses.replace(linear(120), y=noise), ("linear RLS",)).verdicts()[0]
    assert "no learner is distinguished from the model alone" in said


def test_medians_decide_where_few_samples_make_the_rms() -> None:
    """Gross outliers hide in the rms that one learner is twice as good as another."""
    draw = np.random.default_rng(0)
    stream = linear(420)
    noise = np.square(draw.normal(size=400))
    spoilt = np.where(np.arange(400) % 150 == 7, 1e6, 0.0)
    errors = {"model alone": 9.0 * noise, "good": 0.25 * noise, "bad": noise}
    errors = {("linear", name): squared + spoilt for name, squared in errors.items()}
    blocks, alone = np.arange(400) // 20, errors["linear", "model alone"]
    of = {
        key: [block_bootstrap(squared, alone, blocks, measure=m) for m in ("rms", "median")]
        for key, squared in errors.items()
    }
    scores = {key: Score(*key, *both, 0.0, 0.9, 1.0, 1.0) for key, both in of.items()}
    comparison = ComparisonReport((stream,), ("model alone", "bad", "good"), scores, errors)
    assert comparison.measure("linear") == "median"
    assert comparison.best("linear").learner == "good"
    ratio = comparison.ratio("linear", "good", "bad")
    assert (ratio.low, ratio.mean, ratio.high) == pytest.approx((0.5, 0.5, 0.5), rel=0.02)
    assert "good is best, by the median 0." in comparison.verdicts()[0]
    assert "one row in a hundred" in comparison.verdicts()[0]
    assert re.search(r"bad has (2.0|1.9)", comparison.verdicts()[0])


def test_the_answer_among_the_inputs_is_suspected() -> None:
    stream = linear(60)
    given = dataclasses.replace(stream, x=torch.cat([stream.x, stream.y @ WEIGHTS.T], dim=1))
    told = [compare(one, ("linear RLS",)).verdicts()[0] for one in (stream, given)]
    assert ["is what was measured among them" in text for text in told] == [False, True]


def test_tables_hold_the_scores(compared: Comparison) -> None:
    table = score_table(compared, "linear")
    row = next(row for row in table.rows if row[0].startswith("linear RLS"))
    assert row[0].endswith("*")
    assert row[1] == compared.scores["linear", "linear RLS"].rms
    assert row[3] is None  # it is the best itself
    assert [row[0] for row in overview_table(compared).rows] == ["model alone", "linear RLS", "SOGP plain"]
    assert [cell.endswith("*") for cell in overview_table(compared).rows[1][1:]] == [True, True]


def test_samples_that_go_together_widen_the_interval() -> None:
    draw = np.random.default_rng(0)
    ours = np.repeat(draw.exponential(size=20), 50)  # whole blocks are good or bad
    theirs = np.ones(1000)
    blocks = block_bootstrap(ours, theirs, np.arange(1000) // 50)
    single = block_bootstrap(ours, theirs, np.arange(1000))
    assert blocks.high - blocks.low > 4 * (single.high - single.low)


def test_what_is_finished_is_not_run_again(tmp_path: Path) -> None:
    first = compare(linear(60), ["linear RLS"], folder=tmp_path)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.json")}
    again = compare(linear(60), ["linear RLS"], folder=tmp_path)
    assert again.scores == first.scores  # to the microsecond: it was read
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.json")} == times
    compare(linear(60, seed=5), ["linear RLS"], folder=tmp_path)  # other data: not the same job
    assert len(list(tmp_path.glob("*.json"))) == 2


def test_what_cannot_be_compared() -> None:
    for streams, learners in (([], ("linear RLS",)), (linear(60), {})):
        with pytest.raises(ParameterError, match="at least one"):
            compare(streams, learners)
    with pytest.raises(ShapeError, match="one input for each output"):
        Stream("uneven", torch.zeros(50, 2), torch.zeros(49, 1))


@pytest.mark.parametrize("name", COMPARED)
def test_every_contender_runs(name: str) -> None:
    result = run_one(linear(44), learner_factory(name))
    assert len(result["squared"]) == 24
    assert np.isfinite(result["squared"]).all()
    assert 0 <= result["coverage"] <= 1


def test_wide_tables_are_printed_whole_into_a_file(capsys: pytest.CaptureFixture[str]) -> None:
    cell = "0.123 [0.100, 0.200]"
    table = Table("wide", "Wide", [f"recording {k}" for k in range(12)], [["first", *[cell] * 11]], "")
    print_report(Report("", "", [table]), Path())
    out = capsys.readouterr().out
    assert out.count(cell) == 11
    assert max(map(len, out.splitlines())) <= 120


def test_every_kind_of_learner_in_the_package_contends() -> None:
    import torch_ekm.residual as residual

    kinds = tuple(type(make(2, 1)) for name, make in LEARNERS.items() if name in COMPARED)
    for name in dir(residual):
        cls = getattr(residual, name)
        if isinstance(cls, type) and issubclass(cls, residual.ResidualLearner):
            assert cls is residual.ResidualLearner or issubclass(cls, kinds), f"{name} is not compared"


def test_an_absurd_density_is_told(compared: Comparison) -> None:
    scores = {key: dataclasses.replace(score, nll=1e6) for key, score in compared.scores.items()}
    absurd = dataclasses.replace(compared, scores=scores).verdicts()[0]
    assert "Errors far beyond the stated variance (NLL): model alone, linear RLS, SOGP plain" in absurd
    assert "NLL" not in compared.verdicts()[0]
