"""The benchmark of broken tendons runs, and finds them."""

from __future__ import annotations

import sys

import pytest

pytest.importorskip("mujoco", reason="extra 'mujoco'")


def test_broken_tendons_are_found(monkeypatch, capsys) -> None:
    import hand_health

    monkeypatch.setattr(sys, "argv", ["hand_health.py", "--quick"])
    hand_health.main()
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith(
        "yale_t42: broken tendons found within 5 motions 3/3, right actuator 3/3, false alarms 0 in"
    )
