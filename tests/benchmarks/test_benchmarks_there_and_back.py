"""Turns without a new grasp: what is asked, what is counted, and that it runs; and the ends of workspaces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("there_and_back", reason="the benchmarks are not part of this installation")

import there_and_back
import workspace
from there_and_back import BACK, BESIDE, LEAST, RANDOM, THERE, UNDONE, Outcome, Turn, random_sizes


def turn(part: str, number: int, size: float, motions: int = 6, **other) -> Turn:
    usual = {"reason": "reached", "lost": False, "reached": True, "error": 0.1, "shift": (0.0, 0.0, 0.0)}
    return Turn(part, "box", 0, number, size, motions=motions, **{**usual, **other})


def test_random_targets_stay_near_the_start_and_are_no_small_turns() -> None:
    for seed in range(20):
        sizes = np.array(random_sizes(seed))
        assert np.abs(np.cumsum(sizes)).max() <= THERE + 0.1 * len(sizes)
        assert (np.abs(sizes) >= LEAST - 0.1).all()
        assert (np.abs(sizes) <= THERE).all()
        assert sizes.min() < 0 < sizes.max()


def test_losses_motions_and_drift_are_those_of_the_series() -> None:
    away = {"reason": "object lost", "lost": True, "reached": False, "shift": (9.0, 9.0, 9.0)}
    outcome = Outcome(
        [
            turn(BACK, 0, 15.0, motions=6),
            turn(BACK, 1, -15.0, motions=8, shift=(0.1, -1.0, 0.2), slid=0.3),
            turn(BACK, 2, 15.0, motions=6),
            turn(BACK, 3, -15.0, motions=8, shift=(0.1, -2.0, 0.2)),
            turn(UNDONE, 0, 15.0, motions=7),
            turn(UNDONE, 1, -15.0, motions=7, shift=(0.1, 0.1, 0.2)),
            turn(RANDOM, 0, 8.0, motions=6),
            turn(RANDOM, 1, -8.0, motions=40, **away),
            turn(BESIDE[BACK], 0, 15.0, motions=7),
            turn(BESIDE[BACK], 1, 15.0, motions=7),  # another mix of directions than the series have
            turn(BESIDE[BACK], 2, -15.0, motions=5),
            turn(BESIDE[RANDOM], 0, 8.0, motions=5),
            turn(BESIDE[RANDOM], 1, -8.0, motions=5),
        ]
    )
    assert outcome.ratio(BACK) == pytest.approx(14 / 12)
    assert outcome.ratio(RANDOM) == pytest.approx(1.2)
    assert (
        outcome.verdict
        == "lost 1 of 8; motions 1.18 times those of fresh grasps; drift at the end 2.0 mm, undone 0.1 mm"
    )
    rows = {row[0]: row[1:] for row in outcome.table().text()}
    assert rows["random targets, -"] == ["1", "1", "0", "-", "-", "1 object lost"]
    drift = outcome.drift_table().text()
    assert drift[0] == ["box, there and back", "1", "1", "-1.00", "-1.00", "0.10", "0.20", "0.30"]
    assert drift[1][:4] == ["box, there and back, shift undone", "1", "1", "0.10"]
    outcome.picture()


def test_a_quick_run_prints_its_verdict_and_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(there_and_back, "WARM_UP", ())
    monkeypatch.setattr(there_and_back, "BESIDE", {BACK: BESIDE[BACK], UNDONE: BESIDE[UNDONE]})
    monkeypatch.setattr(there_and_back, "THERE", 5.0)
    words = ["--quick", "--seeds", "6:7", "--jobs", "1", "--out", str(tmp_path)]
    there_and_back.main(words)
    first = capsys.readouterr().out.splitlines()[-1]
    assert first.startswith("lost 0 of 4; motions ")
    assert (tmp_path / "there_and_back.svg").exists()
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("box_*.json")}
    assert len(kept) == 3
    there_and_back.main(words)
    assert capsys.readouterr().out.splitlines()[-1] == first
    assert kept == {path: path.stat().st_mtime_ns for path in kept}


def test_an_end_is_what_nine_of_ten_grasps_reach(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    assert workspace.end_of([30.9] + [40.0] * 19) == 40
    assert workspace.end_of([30.9] * 4 + [40.0] * 4) == 30
    monkeypatch.setattr(workspace, "_GRASPS", 1)
    monkeypatch.setattr(workspace, "WARM_UP", 3.0)
    words = ["--objects", "box", "--quick", "--seeds", "6:7", "--engine", "mujoco", "--jobs", "1"]
    workspace.main([*words, "--out", str(tmp_path)])
    assert capsys.readouterr().out.splitlines()[-1] in ("ends [deg]: box 4", "ends [deg]: box 5")
