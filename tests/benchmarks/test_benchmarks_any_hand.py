"""The survey of hands of other kinds: its plants, what it counts, and that a session runs."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import pytest

pytest.importorskip("any_hand", reason="the benchmarks are not part of this installation")

import any_hand
from any_hand import FAMILIES, OTHERS, Survey, Turns, plants

from torch_ekm.experiments.records import TrialRecord
from torch_ekm.simulation import preset


def record(reason: str, steps: int, off: float = 0.0) -> TrialRecord:
    return TrialRecord(
        "box", "turn", "E-KM", 0, 1, 19.0, reason, "", 0.1, (19.0, 0.1), 0.1, 0.1, (), (), (), (), off,
        (0.01,) * steps,
    )  # fmt: skip


def test_every_family_has_three_strengths_that_differ_from_the_nominal_hand() -> None:
    nominal = preset("nominal")
    found = plants(["all"])
    assert len(found) == 3 * len(FAMILIES) + len(OTHERS)
    assert len(set(found.values())) == len(found)
    for family in FAMILIES:
        changed = [_changes(found[family, strength]) for strength in any_hand.STRENGTHS]
        assert changed[0] == changed[1] == changed[2] != set()
        assert "hardware_seed" not in changed[0]
    assert set(plants(["strong"])) == {(f, "strong") for f in FAMILIES} | {(name, "") for name in OTHERS}
    assert plants(["arms:weak", "nominal"])["nominal", ""] == nominal
    with pytest.raises(SystemExit, match="'arm' is no family: arms"):
        plants(["arm"])


def _changes(plant) -> set[str]:
    return {
        field.name
        for field in dataclasses.fields(plant)
        if getattr(plant, field.name) != getattr(preset("nominal"), field.name)
    }


def test_lost_missed_and_motions_are_counted(tmp_path: Path) -> None:
    ours = [
        record("reached", 6),
        record("reached", 8),
        record("stalled", 20),
        record("given up", 9, off=31.0),
    ]
    theirs = [record("reached", 14)] * 3 + [record("object lost", 3)]
    theirs[1] = dataclasses.replace(theirs[1], seconds=(0.0,) * 10)  # the third has no turn to compare with
    ours, theirs = ([dataclasses.replace(r, trial=k) for k, r in enumerate(rs)] for rs in (ours, theirs))
    turns = Turns(tuple(ours))
    assert (turns.lost, turns.missed, turns.reached, turns.motions) == (1, 1, 2, 7.0)
    assert math.isnan(Turns(()).motions)
    survey = Survey({("arms", "strong", "KM+I"): theirs, ("arms", "strong", "E-KM"): ours})
    verdict = "E-KM lost 1 of 4, reached 2, motions 7.0; KM+I lost 1 of 4, reached 3, motions 12.7"
    assert survey.verdict == verdict
    assert survey.totals().text() == [["KM+I", "4", "1", "3", "12.7"], ["E-KM", "4", "1", "2", "7.0"]]
    row = survey.table().text()[0]
    assert row == ["arms strong", "4", "1, 3, 12.7", "1, 2, 7.0", "58", "1 stalled, 1 given up"]
    survey.report(tmp_path, "mujoco")
    assert verdict in (tmp_path / "report.md").read_text(encoding="utf-8")
    assert (tmp_path / "any_hand_mujoco.svg").exists()


def test_a_session_runs_and_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("sapien")
    monkeypatch.setattr(any_hand, "ANGLES", (4.0,))
    monkeypatch.setattr(any_hand, "WARM_UP", 0)
    words = ["any_hand.py", "--quick", "--controllers", "E-KM", "--jobs", "1", "--out", str(tmp_path)]
    monkeypatch.setattr("sys.argv", words)
    any_hand.main()
    first = capsys.readouterr().out.splitlines()[-1]
    assert first.startswith("E-KM lost 0 of 1, reached 1, motions ")
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("odd_1_box_E-KM_*.json")}
    assert len(kept) == 1
    any_hand.main()
    assert capsys.readouterr().out.splitlines()[-1] == first
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
