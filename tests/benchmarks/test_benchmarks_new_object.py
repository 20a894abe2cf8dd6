"""Objects that a hand has never held: what is compared, and that a session runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("new_object", reason="the benchmarks are not part of this installation")

import new_object
from new_object import CONTENDERS, Comparison

from torch_ekm.experiments import runner
from torch_ekm.experiments.records import TrialRecord


def record(item: str, kind: str, ekm: tuple[float, ...], reason: str = "reached") -> TrialRecord:
    n = len(ekm)
    return TrialRecord(
        item, kind, "E-KM", 0, 1, 19.0, reason, "", 0.1, (19.0, 0.1), 0.1, 0.1, (), (), (0.5,) * n, ekm, 0.0,
        (0.01,) * n,
    )  # fmt: skip


def test_first_motions_are_those_of_an_object_and_of_a_turn(tmp_path: Path) -> None:
    results = {}
    for name, scale in zip(CONTENDERS, (2.0, 1.0, 1.5), strict=True):
        results[name, 0] = [
            record("box", "first", (9.0,) * 6),
            record("can", "turn", tuple(scale * x for x in (0.4, 0.2, 0.2, 0.1))),
            record("can", "turn", (0.1 * scale, 0.3)),
            record("jar", "turn", (0.1 * scale,), "object lost"),
        ]
    found = Comparison(results)
    # of the can .4, .2, .2, .1 and, in the next turn, .1; of the jar .1
    assert found.early("learned hand", "ekm") == pytest.approx(1.1 / 6)
    assert found.later("learned hand", "ekm") == pytest.approx(0.3)
    assert found.first_motion("learned hand", "ekm") == pytest.approx(0.2)
    assert found.early("learned hand", "ekm", "box", "first") == 9.0
    verdict = (
        "first five motions KM 0.50, empty 0.37, learned hand 0.18 deg; first motion 0.20 deg; lost 1 of 3"
    )
    assert found.verdict == verdict
    together, each = found.tables()
    assert [row[0] for row in together.text()] == ["all"] * 3
    row = each.text()[1]
    assert row == ["can", "learned hand", "0.50", "0.20", "0.30", "0.25 (50 %)", "0, 2 of 2", "3.0"]
    found.report(tmp_path)
    assert verdict in (tmp_path / "report.md").read_text(encoding="utf-8")
    assert (tmp_path / "new_object.svg").exists()


def test_the_hand_is_kept_and_the_learner_is_not(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("sapien")
    monkeypatch.setattr(new_object, "ANGLES", (4.0,))
    monkeypatch.setattr(runner, "_MOTIONS", 1)
    monkeypatch.setattr(runner, "_LEARNS_BY", (4.0,))
    knowledge, learners = [], []

    class Noted(new_object.Bench):
        def trial(self, *what, **options):
            done = super().trial(*what, **options)
            knowledge.append(self.knowledge)
            learners.append(self.learner)
            return done

    monkeypatch.setattr(new_object, "Bench", Noted)
    monkeypatch.setattr(new_object, "Setting", partial(new_object.Setting, hand="planar_two_finger"))
    words = ["new_object.py", "--quick", "--then", "can", "--seeds", "6:7", "--jobs", "1"]
    monkeypatch.setattr("sys.argv", [*words, "--out", str(tmp_path)])
    new_object.main()
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("first five motions KM ")
    assert line.endswith("lost 0 of 1")
    assert len(knowledge) == 2 * len(CONTENDERS)
    for k in range(0, len(knowledge), 2):
        assert knowledge[k] is knowledge[k + 1]
        assert learners[k] is not learners[k + 1]
