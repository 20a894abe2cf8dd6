"""Streams, scores and the real hand's recordings, where they are at hand (``TORCH_EKM_DATA``)."""

import os
from pathlib import Path

import default_learner
import numpy as np
import pytest
import score_learners
import torch
from as_published import sogp

from torch_ekm.experiments import compare
from torch_ekm.experiments.learner_comparison.prequential import Prequential
from torch_ekm.experiments.learner_comparison.recordings import load_t42
from torch_ekm.residual import CalibrateNoise, ForgettingFactor, RobustWeight

DATA = os.environ.get("TORCH_EKM_DATA", "")
needs_data = pytest.mark.skipif(
    not Path(DATA).is_dir() or not DATA, reason="TORCH_EKM_DATA names no folder with the recordings"
)


def test_scores_by_hand():
    y = torch.tensor([[1.0], [-2.0], [3.0], [4.0]], dtype=torch.float64)
    run = Prequential(0.5 * y, torch.ones_like(y), y, 0.0)
    assert float(run.coverage()) == pytest.approx(0.75)  # |error| is .5, 1, 1.5, 2
    expected = 0.5 * np.log(2 * np.pi) + 0.125 * float(y.square().mean())
    assert run.nll() == pytest.approx(expected)


def test_a_regression_set_is_drawn_by_a_seed(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_EKM_DATA", str(tmp_path))
    (tmp_path / "uci").mkdir()
    values = np.random.default_rng(0).normal(3.0, 5.0, size=(400, 5))
    np.savetxt(tmp_path / "uci" / "power-plant.csv", values, delimiter=",", header="a,b,c,d,y", comments="")
    one, other = (score_learners.shuffled("powerplant", seed, 300) for seed in (0, 1))
    assert (one.x.shape, one.y.shape) == ((300, 4), (300, 1))
    assert not torch.equal(one.x[:5], other.x[:5])


@needs_data
def test_nominal_model_of_the_real_hand_leaves_unit_residuals():
    recordings = load_t42()
    assert len(recordings) == 17
    assert all(bool(r.x.isfinite().all() and r.y.isfinite().all()) for r in recordings)
    assert recordings[0].x.shape[1:] == (15,)
    assert 0.5 < float(np.median([float(r.y[:, 0].std()) for r in recordings])) < 2.0


@needs_data
def test_the_learner_helps_on_a_real_hand():
    def make(d, m):
        parts = [RobustWeight(3.0), CalibrateNoise(), ForgettingFactor(0.99)]
        return sogp(d, m, noise_variance=0.3, parts=parts)

    report = compare(score_learners.hand("reported", 300), {"ours": make})
    score = report.scores["t42", "ours"]
    assert score.rms.mean < 1.0
    assert 0.85 < score.coverage < 0.95


def test_the_benchmark_of_the_default_learner_runs(tmp_path, capsys):
    default_learner.main(["--quick", "--out", str(tmp_path)])
    told = capsys.readouterr().out
    for row in ("| smooth |", "| pure noise, error", "| jump of 3 sd", "| arm at 100 Hz"):
        assert row in told
    assert (tmp_path / "streams.svg").exists()
