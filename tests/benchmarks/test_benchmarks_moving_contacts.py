"""Contacts that slide, open and close: what is counted, and that a session runs."""

from __future__ import annotations

from pathlib import Path

import pandas
import pytest

pytest.importorskip("moving_contacts", reason="the benchmarks are not part of this installation")
pytest.importorskip("mujoco")

import moving_contacts
from moving_contacts import Witness, errors, slips, verdict

from torch_ekm.simulation import SimulatedHand


def motion(plant: str, slid: float, step: float, slide: float, links: int = 0) -> dict:
    said = {"plant": plant, "slid": slid, "km": 5 * step, "step": step, "slide": slide}
    return {**said, "links": links, "ms": 2.0}


def test_slips_are_announced_and_false_alarms_counted() -> None:
    motions = pandas.DataFrame(
        [
            motion("described", 0.0, 0.05, 0.0),
            motion("described", 3e-4, 0.2, 3e-4, links=1),
            motion("nominal", 0.0, 0.1, 2e-4),
            motion("nominal", 2e-4, 0.1, 1e-6),
            motion("nominal", 2e-4, 0.1, 2e-4),
            motion("nominal", 3e-4, float("nan"), float("inf")),  # refused: an alarm
        ]
    )
    assert verdict(motions) == (
        "slid: KM 1.00, step 0.20 deg; slips of nominal hands announced 67 %, false 100 %; a step 2.0 ms"
    )
    rows = {row[0]: row[1:] for row in slips(motions).text()}
    assert rows["nominal"] == ["67 % of 3", "100 % of 1", "100 % of 1"]
    kinds = {row[0]: row[1:] for row in errors(motions).text()}
    assert kinds["a link touches"] == ["1", "1.000", "1.000", "0.200", "0.200"]


def test_the_witness_sees_no_slip_at_rest() -> None:
    plant = SimulatedHand("icub_right", "box", engine="mujoco")
    plant.reset(0)
    witness = Witness(plant)
    plant.wait(0.2)
    assert len(witness.frames) > 0
    assert max(witness.slips().values()) < 2e-6
    plant.close()


def test_a_session_runs(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(moving_contacts, "MOTIONS", 3)
    moving_contacts.main(
        ["--quick", "--objects", "box", "--seeds", "7:8", "--jobs", "1", "--out", str(tmp_path)]
    )
    assert capsys.readouterr().out.splitlines()[-1].startswith("slid: KM ")
    assert (tmp_path / "motions.csv").exists()
