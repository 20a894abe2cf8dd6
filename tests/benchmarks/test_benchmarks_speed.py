"""The table of speeds: that it runs, and what it says of times that are given."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sapien")
pytest.importorskip("gpytorch")
pytest.importorskip("river")
pytest.importorskip("numba")
pytest.importorskip("speed", reason="the benchmarks are not part of this installation")

import speed


def test_what_is_said_of_times() -> None:
    times = {
        "motion": [0.004] * 98 + [0.02, 0.02], "update": [1e-4, 3e-4], "linearize": [0.002],
        "first update, fresh installation": [1.5],
    }  # fmt: skip
    said = speed.Speed(times).verdict
    expected = "motion 4.00 ms (99 % 20.00), default update 200 us mean (99 % 298), cold start 1.50 s, "
    assert said == expected + "linearize 2.00 ms"


@pytest.mark.slow
def test_it_runs(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    speed.main(["--quick", "--out", str(tmp_path)])
    last = capsys.readouterr().out.splitlines()[-1]
    motion, update = r"motion \S+ ms \(99 % \S+\)", r"default update \d+ us mean \(99 % \d+\)"
    assert re.fullmatch(rf"{motion}, {update}, cold start \S+ s, linearize \S+ ms", last)
    assert (tmp_path / "speed.svg").is_file()
    rows = (tmp_path / "speed.csv").read_text().splitlines()
    assert len(rows) == 10
    assert np.finfo(float).tiny / np.array([4.0]) > 0  # subnormal numbers are as they were
