"""Contacts that slide, open and close: what is counted, and that a session runs."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("moving_contacts", reason="the benchmarks are not part of this installation")

import moving_contacts
from moving_contacts import Comparison


def motion(slid: float, km: float, step: float, margin: float, slide: float, links: int = 0) -> dict:
    return {
        "slid": slid, "km": km, "step": step, "margin": margin, "slide": slide, "links": links, "ms": 2.0
    }  # fmt: skip


def test_slips_are_announced_and_false_alarms_counted(tmp_path: Path) -> None:
    refused = {"slid": 3e-4, "margin": float("-inf"), "slide": float("inf"), "links": 0}
    results = {
        ("box", 0, "described"): {
            "motions": [motion(0.0, 0.1, 0.05, 1.0, 0.0), motion(3e-4, 1.0, 0.2, -1.0, 3e-4, links=1)],
            "turn_km": 3.0, "turn_step": 0.5, "axis_km": 1.0, "axis_step": 0.2,
        },
        ("box", 0, "nominal"): {
            "motions": [
                motion(0.0, 0.1, 0.1, 1.0, 2e-4), motion(2e-4, 0.1, 0.1, 1.0, 1e-6),
                motion(2e-4, 0.1, 0.1, -1.0, 2e-4), refused,
            ]
        },
    }  # fmt: skip
    found = Comparison(results)
    assert found.verdict == (
        "slid: KM 1.00, step 0.20 deg; whole turns 0.50 deg; slips of sensed and nominal hands announced"
        " 67 %, false 100 %; a step 2.0 ms"
    )
    rows = {tuple(row[:2]): row[2:] for row in found.slips().text()}
    assert rows["nominal", "step"] == ["67 % of 3", "0 % of 1", "100 % of 1", "100 % of 1"]
    assert rows["nominal", "margins of the KM"] == ["67 % of 3", "0 % of 1", "0 % of 1", "0 % of 1"]
    kinds = {row[0]: row[1:] for row in found.errors().text()}
    assert kinds["a link touches"] == ["1", "1.000", "1.000", "0.200", "0.200"]
    found.report(tmp_path, "mujoco")
    assert (tmp_path / "moving_contacts_mujoco.svg").exists()


def test_a_session_runs(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(moving_contacts, "MOTIONS", 3)
    words = ["moving_contacts.py", "--quick", "--objects", "box", "--seeds", "7:8", "--jobs", "1"]
    monkeypatch.setattr("sys.argv", [*words, "--out", str(tmp_path)])
    moving_contacts.main()
    assert capsys.readouterr().out.splitlines()[-1].startswith("slid: KM ")
