"""The comparison of engines: what it counts, and that its probe runs in MuJoCo."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("engines", reason="the benchmarks are not part of this installation")
pytest.importorskip("mujoco")

import engines
from engines import Comparison, probe

from torch_ekm.experiments.records import TrialRecord


def record(reason: str, steps: int, error: float) -> TrialRecord:
    return TrialRecord(
        "box", "turn", "E-KM", 0, 1, 19.0, reason, "", error, (19.0, error), 0.1, 0.1, (), (), (0.8,) * steps,
        (0.2,) * steps, 0.0, (0.01,) * steps,
    )  # fmt: skip


def test_what_is_reached_is_counted(tmp_path: Path) -> None:
    turns = {
        ("sapien", "nominal", "E-KM"): [record("reached", 6, 0.1), record("stalled", 30, 3.0)],
        ("mujoco", "nominal", "E-KM"): [record("reached", 8, -0.2), record("object lost", 2, 9.0)],
    }
    figures = {"error": 0.01, "shift": 0.02, "creep": 0.1, "moved": 0.2, "time": 0.1}
    compared = Comparison(turns, {("sapien", "box"): [figures], ("mujoco", "box"): []})
    assert compared.verdict == "sapien 0.100 deg 6.0 motions lost 0; mujoco 0.200 deg 8.0 motions lost 1"
    rows = compared.table().rows
    assert [row[1:5] for row in rows] == [["SAPIEN", 2, 0, 1], ["MuJoCo", 2, 1, 1]]
    assert len(compared.probe_table().rows) == 1
    compared.report(tmp_path)
    assert (tmp_path / "engines.svg").is_file()


def test_the_model_without_mismatch_is_right_in_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    """The median is said to be below .05 deg."""
    monkeypatch.setattr(engines, "_STEPS", 3)
    monkeypatch.setattr(engines, "_REST", 2.0)
    found = probe("mujoco", "bottle", 12)
    assert found is not None
    assert found["error"] < 0.05
    assert found["creep"] < 0.1
