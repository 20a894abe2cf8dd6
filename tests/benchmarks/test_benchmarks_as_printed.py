"""The paper's own system: what it is made of, what is counted, and that a session runs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

pytest.importorskip("as_printed", reason="the benchmarks are not part of this installation")

import as_printed
from as_printed import SYSTEMS, MisprintedBench, PrintedBench, Systems

from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.records import Trial, TrialRecord
from torch_ekm.model import KinematicModel


def record(error: float, reason: str = "reached") -> TrialRecord:
    return TrialRecord(
        "box", "turn", "E-KM", 0, 1, 20.0, reason, "", error, (20.0, error), 0.1, 0.1, (), (), (0.5,), (0.5,),
        0.0, (0.01,),
    )  # fmt: skip


def test_a_lost_object_counts_with_the_whole_angle() -> None:
    errors = {"KM, as printed": (2.0, 4.0), "E-KM, as printed": (1.0,), "KM": (1.0, 3.0), "E-KM": (0.5,)}
    turns = {
        (name, "box", seed): [record(error)]
        for name in SYSTEMS
        for seed, error in enumerate(errors.get(name, (1.0,)))
    }
    turns["E-KM, as printed", "box", 0].append(record(3.0, "object lost"))
    found = Systems(turns)
    assert found.errors("E-KM, as printed") == pytest.approx([10.5])
    rows = {row[0]: row for row in found.summary().text()}
    assert rows["E-KM, in the paper"][1:3] == ["0.64", "40"]
    assert rows["E-KM, as printed"][2:5] == ["350", "1", "1"]  # 10.5 of 3 deg
    assert rows["E-KM"][2] == "25"
    assert "E-KM:KM as printed 350 %, with tasks 100 %, here 25 %" in found.verdict


def test_some_systems_alone_are_told_without_the_others() -> None:
    pair = {("E-KM", "box", 0): [record(0.1)], ("E-KM without fingertips", "box", 0): [record(0.2)]}
    found = Systems(pair)
    assert found.verdict == "E-KM 0.10 deg, lost 0 of 1; E-KM without fingertips 0.20 deg, lost 0 of 1"
    assert [row[0] for row in found.summary().text()][2:] == ["E-KM", "E-KM without fingertips"]
    assert found.ends().text() == [["reached", "1", "1"]]


def test_the_misprinted_stiffness_is_the_papers_letter_by_letter() -> None:
    """``D_oq dq = sum_i (J_i dq) x f_i``, the printed sign of T; the object's own columns are empty."""
    pytest.importorskip("mujoco")
    bench = MisprintedBench(as_printed.as_printed(Setting(engine="mujoco")), "box", "KM")
    state = bench.grasp(3, 0)
    assert state is not None
    kin = bench.model.contact_kinematics(state, bench.model.contacts(state))
    random = torch.Generator().manual_seed(0)
    force = torch.randn(len(kin.point_jacobian), 3, generator=random, dtype=torch.float64)
    D, n_q = bench.model.load_stiffness(kin, force, torch.zeros(len(force))), len(state.q)
    dq = torch.linspace(-1, 1, n_q, dtype=torch.float64)
    moment = torch.linalg.cross(kin.point_jacobian @ dq, force).sum(0)
    torch.testing.assert_close(D[n_q + 3 :, :n_q] @ dq, moment)
    assert not D[:, n_q:].any()
    assert not D[n_q : n_q + 3].any()
    right = KinematicModel.load_stiffness(bench.model, kin, force, torch.zeros(len(force)))
    torch.testing.assert_close(D[:n_q, :n_q], right[:n_q, :n_q])  # pinned contacts: S
    step = bench.trial(3, 0, 3.0).steps
    assert step > 0
    bench.close()


def test_the_system_has_what_the_paper_prints_and_no_more() -> None:
    pytest.importorskip("sapien")
    bench = PrintedBench(as_printed.as_printed(Setting(hand="planar_two_finger")), "box", "E-KM")
    start = bench.grasp(3, 0)
    assert start is not None
    done = bench.turn(Trial("box", "turn", "E-KM", 3, 0, 3.0), start)
    steps = bench.last.steps
    assert done.steps == len(steps) > 0
    for step in steps:
        assert step.before.fingertip_force is None
        assert len(step.decision.pieces) == 1
        # commands are those that were decided: nothing is inverted, and nothing learns the hand
        assert torch.equal(step.pull, step.after.a - step.before.a)
    assert not len(bench.learner.parts)  # every sample is trusted, and none is forgotten
    assert not bench.knowledge.servo.learns
    assert not hasattr(bench.knowledge.figures, "mean")
    lin = steps[1].decision.linearization
    alone = bench.model.linearize(lin.state).forces.normal
    torch.testing.assert_close(lin.forces.normal, alone)  # neither pads nor the forces before
    bench.close()


def test_quick_run_prints_its_verdict(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("sapien")
    from functools import partial

    monkeypatch.setattr(as_printed, "Setting", partial(Setting, hand="planar_two_finger"))
    monkeypatch.setattr(as_printed, "WARM_UP", 1)
    as_printed.main(["--quick", "--seeds", "6:7", "--jobs", "1", "--out", str(tmp_path)])
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("KM, as printed ")
    assert "E-KM, with tasks " in line
    assert (tmp_path / "index.html").exists()
