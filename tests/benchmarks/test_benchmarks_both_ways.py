"""How far one grasp turns an object, back and forth."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("both_ways", reason="the benchmarks are not part of this installation")

import both_ways
from both_ways import Ranges, Way


def way(seed: int, sign: int, reached: float, **other) -> Way:
    usual = {"reason": "reached", "lost": False, "motions": 9, "ends_by": "link: thumb_2"}
    return Way("can", seed, sign, 1.1 * reached, asked=reached, reached=reached, **{**usual, **other})


def test_ranges_count_from_end_to_end_and_losses_are_no_success() -> None:
    gone = {"reason": "object lost", "lost": True}
    ranges = Ranges(
        [way(0, -1, -20.0), way(0, 1, 45.0), way(1, -1, -10.0), way(1, 1, 30.0), way(2, -1, -70.0, **gone)]
    )
    assert ranges.verdict == "65 deg in all (median); 60 deg in 1 of 3 grasps; lost 1"
    row = ranges.table().text()[0]
    assert row[:6] == ["can", "3", "1", "-20", "38", "65 (40 to 70)"]
    ranges.picture()


def test_a_quick_run_turns_both_ways_and_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(both_ways, "WARM_UP", ())
    words = ["--quick", "--seeds", "6:7", "--engine", "mujoco", "--jobs", "1", "--out", str(tmp_path)]
    both_ways.main(words)
    said = capsys.readouterr().out.splitlines()[-1]
    assert said.endswith("60 deg in 0 of 1 grasps; lost 0")
    assert 7 < float(said.split()[0]) < 13
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("can_*.json")}
    assert len(kept) == 1
    both_ways.main(words)
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
