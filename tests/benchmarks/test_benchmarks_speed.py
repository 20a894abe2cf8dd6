"""The table of speeds: that it runs, and what it says of times that are given."""

import re
from pathlib import Path

import bench_learners
import numpy as np
import pytest
import speed
import torch

from torch_ekm.residual.sparse_gp.engine import recursion


def test_what_is_said_of_times() -> None:
    times = {
        "motion": [0.004] * 98 + [0.02, 0.02], "update": [1e-4, 3e-4], "linearize": [0.002],
        "first update, fresh installation": [1.5], "prediction with Jacobians": [6e-5],
        "update of a fleet, a model": [4e-5, 5e-5, 6e-5],
    }  # fmt: skip
    said = speed.Speed(times, plain={"update": 10.0, "predict": 6.0}).verdict
    expected = (
        "motion 4.00 ms (99 % 20.00), cold start 1.50 s, linearize 2.00 ms, default update 200 us median, "
    )
    expected += "99 % 298 us; Jacobians 60 us; fleet 50 us (20, 30 and 10 times plain C)"
    assert said == expected


def test_it_runs(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    speed.main(["--quick", "--out", str(tmp_path)])
    last = capsys.readouterr().out.splitlines()[-1]
    motion, update = r"motion \S+ ms \(99 % \S+\)", r"default update \d+ us median, 99 % \d+ us"
    rest = r"Jacobians \d+ us; fleet \d+ us \(\d+, \d+ and \d+ times plain C\)"
    assert re.fullmatch(rf"{motion}, cold start \S+ s, linearize \S+ ms, {update}; {rest}", last)
    assert (tmp_path / "speed.svg").is_file()
    rows = (tmp_path / "speed.csv").read_text().splitlines()
    assert len(rows) == 11
    assert np.finfo(float).tiny / np.array([4.0]) > 0  # subnormal numbers are as they were


def test_plain_c_gives_the_same_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    reference = bench_learners.PlainC(30, 6)
    xs, ys = bench_learners.stream(40, 6, seed=5)
    gp = reference.gp

    def loss_in_the_mean(posterior, c, q, w) -> torch.Tensor:  # the C code prunes by the first term of ours
        return posterior.alpha.square().sum(-1) / (c + q)

    monkeypatch.setattr(recursion, "pruning_loss", loss_in_the_mean)
    monkeypatch.setattr(gp, "engine", None)  # it asks for the loss by its name
    for x, y in zip(xs, ys, strict=True):
        reference.update(*(bench_learners.pointer(row.contiguous().numpy()) for row in (x, y)))
        gp.update(x, y)
    x = xs[0] + 0.1
    variance = reference.predict(bench_learners.pointer(x.numpy()))
    ours = gp.predict_with_jacobians(x)
    np.testing.assert_allclose(reference.mean, ours.mean.numpy(), atol=1e-5)
    np.testing.assert_allclose(reference.jac, ours.mean_jacobian.numpy(), atol=1e-5)
    assert variance == pytest.approx(float(ours.variance[0]), abs=1e-5)
