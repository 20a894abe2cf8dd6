"""Whole turns: what is counted, how bands are judged, and that a session runs."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest

pytest.importorskip("whole_turn", reason="the benchmarks are not part of this installation")

import whole_turn
from whole_turn import CONTENDERS, VARIANTS, Comparison, Turn

from torch_ekm.control.safety.on_the_way import OnTheWay
from torch_ekm.experiments.config import Setting

BANDS = ([1, 0.5, 0.2, [0.1, -2.0]], [6, -1.7, 0.1, []])


def turn(reason: str, turning: int, kind: str = "turn", off: float = 1.0, **figures) -> Turn:
    return Turn(
        "box", kind, "E-KM", 0, 1, 27.0, reason, "", 0.1, (27.0, 0.1), 0.1, 0.1, (), (), (), (), off,
        (0.01,) * (turning + 1), turning=turning, simulated_s=0.5 * turning,
        way=([0.0, 0.0], [1.0, 27.0]), **figures,
    )  # fmt: skip


def test_lost_turning_motions_seconds_and_bands_are_counted(tmp_path: Path) -> None:
    ours = [
        turn("reached", 1, bands=BANDS),
        turn("reached", 2, off=3.0),
        turn("given up", 9),
        turn("object lost", 9),
        turn("reached", 7, "first"),
    ]
    found = Comparison(
        {("E-KM", "odd 4", "box", 0): ours, ("without plan", "odd 4", "box", 0): [turn("reached", 8)]}
    )
    verdict = (
        "E-KM lost 1 of 4, reached 2, turning movements 1.5, all motions 2.5, seconds 0.8; "
        "without plan lost 0 of 1, reached 1, turning movements 8.0, all motions 9.0, seconds 4.0"
    )
    assert found.verdict == verdict
    row = found.table("turn", "").text()[0]
    assert row[1:10] == ["4", "1", "2", "1.5", "1.5", "2.5", "0.8", "1.0", "3.0"]
    assert found.table("first", "").text()[0][1:5] == ["1", "0", "1", "7.0"]
    bands = {row[0]: [cell.split(" ")[0] for cell in row[1:]] for row in found.calibration().text()}
    assert bands["E-KM, odd 4"] == ["2", "1/2", "2/2", "1/2"]
    assert bands["E-KM, 1 piece"] == ["1", "1/1", "1/1", "1/2"]
    assert bands["E-KM, 5 pieces or more"] == ["1", "0/1", "1/1", "-"]
    found.report(tmp_path)
    assert (tmp_path / "whole_turn.svg").exists()
    assert verdict in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_contenders_differ_in_what_they_are_called() -> None:
    settings = [(one.controller, one.bench, Setting(**(one.changes or {}))) for one in CONTENDERS.values()]
    assert len({str(one) for one in settings}) == len(CONTENDERS)
    assert Setting(**(CONTENDERS["f alone + plan"].changes or {})).learner == "model alone"
    assert not Setting(**(CONTENDERS["g alone + plan"].changes or {})).follows
    assert len({str(dataclasses.asdict(one)) for one in VARIANTS.values()}) == len(VARIANTS)


def test_a_session_runs_and_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(whole_turn, "LEARNS_BY", (6.0,))
    monkeypatch.setattr(whole_turn, "ANGLES", (7.0,))
    given = ["--quick", "--jobs", "1", "--out", str(tmp_path)]
    whole_turn.main([*given, "--contenders", "E-KM,without plan"])
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("E-KM lost 0 of 1, reached 1, turning movements ")
    assert "; without plan lost 0 of 1, reached 1, turning movements " in last
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("nominal_box_*.json")}
    assert len(kept) == 2
    whole_turn.main([*given, "--contenders", "E-KM,without plan"])
    assert capsys.readouterr().out.splitlines()[-1] == last
    assert kept == {path: path.stat().st_mtime_ns for path in kept}


def test_movements_of_a_loop_without_watch_go_to_their_end(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(whole_turn, "LEARNS_BY", (6.0,))
    monkeypatch.setattr(whole_turn, "ANGLES", (7.0,))
    asked = []
    watch = OnTheWay.__call__
    monkeypatch.setattr(OnTheWay, "__call__", lambda *given: asked.append(1) or watch(*given))
    for name, watched in (("as it is", True), ("no watch on the way", False)):
        asked.clear()
        words = ["--quick", "--variants", "--contenders", name, "--plants", "nominal"]
        whole_turn.main([*words, "--jobs", "1", "--out", str(tmp_path)])
        assert bool(asked) == watched
    assert math.isfinite(float(capsys.readouterr().out.rsplit("seconds", 1)[1]))
