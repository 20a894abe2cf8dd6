"""Fingers that are lifted and set elsewhere."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

pytest.importorskip("regrasp", reason="the benchmarks are not part of this installation")

import regrasp
from regrasp import Lift


def lift(seed: int, support: bool, off: float, **other) -> Lift:
    usual = {"regular": support, "foreseen": math.nan, "moved": 2.0, "lost": False}
    return Lift("box", seed, "middle", support, off=off, **{**usual, **other})


def test_what_is_lost_or_bears_too_little_is_not_set_again() -> None:
    lifts = [
        lift(0, False, 30.0),
        lift(1, False, 0.0, lost=True),
        lift(0, True, 4.0, shift=5.0, force=2.0, remains=3.0, foreseen=5.0),
        lift(1, True, 6.0, shift=5.0, force=0.3, remains=9.0),
        lift(2, True, 8.0, shift=1.0, force=2.0, remains=9.0),
    ]
    assert regrasp.verdict_of(lifts) == (
        "two fingers alone: within 10 deg 0 of 2, set again 0, lost 1; "
        "with support: within 10 deg 3 of 3, set again 1, lost 0"
    )
    alone, supported = regrasp.table(lifts).text()
    assert alone == ["middle", "0 of 2", "none", "1", "30 (to 30)", "2.0", "0", "-"]
    assert supported == ["middle, supported", "3 of 3", "5 (1)", "0", "6 (to 8)", "2.0", "1 (5.0 mm)", "3"]
    regrasp.picture(lifts)


def test_a_quick_run_lifts_the_middle_finger_and_is_kept(tmp_path: Path, capsys) -> None:
    pytest.importorskip("mujoco")
    words = ["--quick", "--seeds", "0:1", "--jobs", "1", "--out", str(tmp_path)]
    regrasp.main(words)
    said = capsys.readouterr().out.splitlines()[-1]
    assert said == (
        "two fingers alone: within 10 deg 0 of 1, set again 0, lost 0; "
        "with support: within 10 deg 1 of 1, set again 1, lost 0"
    )
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("box_*.json")}
    assert len(kept) == 1
    regrasp.main(words)
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
