"""The command line tells everything that it was given to tell."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from torch_ekm.cli import _print_report, app
from torch_ekm.experiments.reporting.report import Report, Table

COMMANDS = typer.main.get_command(app).commands


def said(text: str) -> str:
    """Without line breaks and hyphenation, which depend on the width of a terminal."""
    return re.sub(r"\s+", "", text)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_tells_all_of_every_option(name: str) -> None:
    shown = CliRunner().invoke(app, [name, "--help"])
    assert shown.exit_code == 0, shown.output
    for parameter in COMMANDS[name].params:
        assert said(parameter.help or "") in said(shown.output), parameter.name
    assert said(COMMANDS[name].help) in said(shown.output)


def test_some_help_has_units_in_brackets() -> None:
    assert "[deg]" in CliRunner().invoke(app, ["reproduce", "--help"]).output
    assert "[deg]" in CliRunner().invoke(app, ["record", "--help"]).output


def test_units_of_a_table_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    shown = CliRunner().invoke(app, ["objects"])
    assert "mass [g]" in shown.output
    assert "grasp width [mm]" in shown.output
    table = Table(
        "errors", "Errors [deg]", ["case", "KM [deg]"], [["box", "0.5 [0.4, 0.6]"]], "per turn [deg]"
    )
    _print_report(Report("", "", [table]), Path(), notes=True)
    printed = capsys.readouterr().out
    for text in ("Errors [deg]", "KM [deg]", "0.5 [0.4, 0.6]", "per turn [deg]"):
        assert text in printed
