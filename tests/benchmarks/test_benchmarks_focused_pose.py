"""Focused poses of several directions: what is asked, what is counted, and that it runs."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch

pytest.importorskip("focused_pose", reason="the benchmarks are not part of this installation")

import focused_pose
from focused_pose import TARGETS, Outcome, Part, Trial, target_of

from torch_ekm.kinematics import GraspState

AXES = dict(zip("abc", torch.eye(3, dtype=torch.float64), strict=True))


def trial(reason: str, errors: dict[str, float], **other) -> Trial:
    about = {"group": "shift 3 mm", "message": "", "motions": 5, "lost": False, **other}
    return Trial(name="+a", object="box", seed=0, reason=reason, errors=errors, **about)


def test_targets_have_one_to_six_directions_each_named_once() -> None:
    sizes = set()
    for parts in itertools.chain.from_iterable(group.values() for group in TARGETS.values()):
        assert len({(part.unit, part.axis) for part in parts}) == len(parts)
        assert any(part.size for part in parts)
        sizes.add(len(parts))
    assert sizes == {1, 2, 3, 5, 6}


def test_a_target_is_turned_about_one_axis_and_moved_along_another() -> None:
    start = GraspState(torch.zeros(4), torch.ones(3, dtype=torch.float64), torch.eye(3, dtype=torch.float64))
    error = target_of(start, (Part("deg", "a", 8.0), Part("mm", "b", -3.0)), AXES).error(start)
    assert torch.rad2deg(error[3:]).tolist() == pytest.approx([8.0, 0.0, 0.0])
    assert error[:3].tolist() == pytest.approx([0.0, -3e-3, 0.0])


def test_errors_of_both_units_count_and_what_is_declined_does_not(tmp_path: Path) -> None:
    outcome = Outcome(
        [
            trial("reached", {"mm": 0.1}),
            trial("stalled", {"deg": 0.1, "mm": 0.19}, group="turn 8 deg about a, shift 3 mm"),
            trial("reached", {"deg": 0.26, "mm": 0.1}, group="turn 8 deg about a, shift 3 mm"),
            trial("object lost", {"mm": 40.0}, lost=True),
            trial("out of reach", {"mm": 0.0}, message="the motors hold 5 of 6"),
        ]
    )
    assert outcome.verdict == "reachable 4 of 5; of these within 0.25 deg and 0.2 mm 50 %; lost 1"
    rows = {row[0]: row[1:] for row in outcome.table().text()}
    assert rows["shift 3 mm (1)"][:3] == ["3", "2", "1"]
    assert rows["turn 8 deg about a, shift 3 mm (2)"] == ["2", "2", "1", "0.18", "0.15", "5.0", "0"]
    ends = [row[1:3] for row in outcome.ends().text()]
    assert ends == [["object lost", "1"], ["out of reach", "1"], ["reached", "1"]]
    assert "rank or gain" in outcome.ends().text()[1][3]
    outcome.picture()


def test_a_quick_run_prints_its_verdict_and_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(focused_pose, "WARM_UP", (5.0,))
    few = {"shift 3 mm": {"+b": TARGETS["shift 3 mm"]["+b"]}, "whole pose": TARGETS["whole pose"]}
    monkeypatch.setattr(focused_pose, "TARGETS", few)
    words = ["--quick", "--seeds", "6:7", "--jobs", "1", "--out", str(tmp_path)]
    focused_pose.main(words)
    first = capsys.readouterr().out.splitlines()[-1]
    assert first == "reachable 1 of 3; of these within 0.25 deg and 0.2 mm 100 %; lost 0"
    assert (tmp_path / "focused_pose.svg").exists()
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("box_*.json")}
    assert len(kept) == 1
    focused_pose.main(words)
    assert capsys.readouterr().out.splitlines()[-1] == first
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
