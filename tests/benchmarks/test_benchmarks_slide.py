"""A finger slides along the object on purpose."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("slide", reason="the benchmarks are not part of this installation")

import slide
from slide import Slide


def one(seed: int, slid: list[float], predicted: list[float], ended: str) -> Slide:
    return Slide("box", seed, "described", "index", "axis", -1.0, slid, predicted, 0.1, 1.0, 2.0, ended)


def test_predictions_are_those_of_single_motions() -> None:
    slides = [
        one(0, [1.0, 3.2], [1.1, 2.0], "reached"),
        one(1, [0.5, 0.4], [0.5, 0.1], "turned"),
        one(2, [], [], "lost"),
    ]
    assert slide.verdict_of(slides) == (
        "described: 3 mm in 1 of 3 slides, lost 1; nominal: 3 mm in 0 of 0 slides, lost 0"
    )
    (row,) = slide.table(slides).text()
    case = "described: index, along the axis -"
    assert row == [case, "1 of 3", "1", "2", "1.8", "0.15", "0.1", "1.0 deg, 2.0 mm"]
    slide.picture(slides)


def test_a_quick_run_slides_the_index_finger_as_predicted(tmp_path: Path, capsys) -> None:
    pytest.importorskip("mujoco")
    slide.main(["--quick", "--seeds", "0:1", "--jobs", "1", "--out", str(tmp_path)])
    assert capsys.readouterr().out.splitlines()[-1].startswith("described: 3 mm in 1 of 1 slides, lost 0")
    (kept,) = tmp_path.glob("box_*.json")
    assert "reached" in kept.read_text()
