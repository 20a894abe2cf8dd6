"""The benchmark of broken tendons runs, and finds them."""

import sys


def test_broken_tendons_are_found(monkeypatch, capsys) -> None:
    import hand_health

    monkeypatch.setattr(sys, "argv", ["hand_health.py", "--quick"])
    hand_health.main()
    last = capsys.readouterr().out.splitlines()[-1]
    cases, found, right, _, false = last.strip("|").split("|")[1:]
    assert (cases, found, right, false) == ("3", "3", "3", "0")
