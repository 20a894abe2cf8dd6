"""Streams, scores and the real hand's recordings, where they are at hand (``TORCH_EKM_DATA``)."""

from __future__ import annotations

import dataclasses
import os
import sys
from pathlib import Path

import default_learner
import numpy as np
import pytest
import torch
from as_published import sogp
from stream_scores import median_ratio, rms_ratio

from torch_ekm.exceptions import DescriptionError, UnknownNameError
from torch_ekm.experiments.learner_comparison.prequential import Prequential, run_prequential
from torch_ekm.experiments.learner_comparison.recordings import load_t42
from torch_ekm.experiments.learner_comparison.stream import Stream
from torch_ekm.residual import (
    CalibrateNoise,
    ForgettingFactor,
    RecursiveLeastSquares,
    RobustWeight,
    ZeroResidual,
)

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from stream_scores import Split, load_split, score_objects, score_split, winsorised_ratio

DATA = os.environ.get("TORCH_EKM_DATA", "")
needs_data = pytest.mark.skipif(
    not Path(DATA).is_dir() or not DATA, reason="TORCH_EKM_DATA names no folder with the recordings"
)


def test_missing_folder_and_wrong_name_are_told(monkeypatch):
    monkeypatch.delenv("TORCH_EKM_DATA", raising=False)
    with pytest.raises(DescriptionError, match="TORCH_EKM_DATA"):
        load_t42()
    with pytest.raises(UnknownNameError, match="kin40k"):
        load_split("boston", 0)


def test_scores_by_hand():
    y = torch.tensor([[1.0], [-2.0], [3.0], [4.0]], dtype=torch.float64)
    run = Prequential(0.5 * y, torch.ones_like(y), y, 0.0)
    assert rms_ratio(run) == pytest.approx(0.5)
    assert median_ratio(run, 2) == pytest.approx(0.5)
    assert float(run.coverage()) == pytest.approx(0.75)  # |error| is .5, 1, 1.5, 2
    assert winsorised_ratio(run) == pytest.approx(0.5, rel=0.02)
    glitch = torch.tensor([[1e3]], dtype=torch.float64)
    many = torch.cat([y.repeat(25, 1), glitch])
    missed = Prequential(torch.where(many > 100, 0.0, 0.5 * many), torch.ones_like(many), many, 0.0)
    assert rms_ratio(missed) > 0.99
    assert winsorised_ratio(missed, level=0.98) == pytest.approx(0.5, rel=0.1)
    expected = 0.5 * np.log(2 * np.pi) + 0.125 * float(y.square().mean())
    assert run.nll() == pytest.approx(expected)


def test_prediction_comes_before_learning():
    x = torch.ones(2, 1, dtype=torch.float64)
    y = torch.full((2, 1), 3.0, dtype=torch.float64)
    run = run_prequential(RecursiveLeastSquares(1, 1), x, y)
    assert float(run.mean[0]) == 0.0
    assert float(run.mean[1]) > 2.5


def test_kept_and_fresh_differ_only_from_the_second_object_on():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(60, 3, generator=generator, dtype=torch.float64)
    objects = [Stream(n, x, torch.sin(x[:, :2])) for n in ("a", "b")]
    kept = score_objects(lambda: sogp(3, 2), objects, kept=True)
    fresh = score_objects(lambda: sogp(3, 2), objects, kept=False)
    assert kept[0] == fresh[0] == dataclasses.replace(fresh[1], name="a")
    assert kept[1].rms < 0.5 * fresh[1].rms


def test_a_held_out_part_tells_learners_apart():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(200, 3, generator=generator, dtype=torch.float64)
    split = Split("line", x[:150], x[:150, :1] * 2, x[150:], x[150:, :1] * 2)
    assert score_split(RecursiveLeastSquares, split).rmse < 0.05 < score_split(ZeroResidual, split).rmse


def test_a_regression_set_is_split_and_standardized(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_EKM_DATA", str(tmp_path))
    (tmp_path / "uci").mkdir()
    values = np.random.default_rng(0).normal(3.0, 5.0, size=(400, 5))
    np.savetxt(tmp_path / "uci" / "power-plant.csv", values, delimiter=",", header="a,b,c,d,y", comments="")
    split = load_split("powerplant", 0, limit=300)
    assert (split.x.shape, split.y.shape, split.x_test.shape) == ((270, 4), (270, 1), (30, 4))
    torch.testing.assert_close(split.y.var(0, correction=0), torch.ones(1, dtype=torch.float64))
    assert not torch.equal(split.x[:5], load_split("powerplant", 1, limit=300).x[:5])


@needs_data
def test_public_streams_have_their_known_sizes():
    for name, (n, d, m) in {
        "sarcos": (4449, 21, 7),
        "kin40k": (8000, 8, 1),
        "powerplant": (8000, 4, 1),
    }.items():
        s = load_split(name, 0)
        assert len(s.x) + len(s.x_test) == n
        assert (s.x.shape[1], s.y.shape[1]) == (d, m)
        torch.testing.assert_close(s.y.var(0, correction=0), torch.ones(m, dtype=torch.float64))


@needs_data
def test_nominal_model_of_the_real_hand_leaves_unit_residuals():
    recordings = load_t42()
    assert len(recordings) == 17
    assert all(bool(r.x.isfinite().all() and r.y.isfinite().all()) for r in recordings)
    assert recordings[0].x.shape[1:] == (15,)
    assert 0.5 < float(np.median([float(r.y[:, 0].std()) for r in recordings])) < 2.0


@needs_data
def test_the_learner_helps_on_a_real_hand():
    recordings = load_t42()[7:9]

    def make():
        parts = [RobustWeight(3.0), CalibrateNoise(), ForgettingFactor(0.99)]
        return sogp(15, 3, noise_variance=0.3, parts=parts)

    scores = score_objects(make, recordings, kept=True)
    assert all(s.rms < 1.0 for s in scores)
    assert all(0.85 < c < 0.95 for s in scores for c in s.coverage)


@pytest.mark.slow
def test_the_benchmark_of_the_default_learner_runs(capsys):
    default_learner.main(["--quick"])
    told = capsys.readouterr().out
    for row in (
        "| smooth |",
        "| pure noise, error",
        "| jump of 3 sd",
        "| arm at 100 Hz",
        "| DeepKernelSOGP |",
    ):
        assert row in told
