"""The command line tells everything that it was given to tell."""

import re
import runpy
import warnings
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from torch_ekm._terminal import as_printed, print_report, print_table, progress, unbroken
from torch_ekm.cli import app, main
from torch_ekm.cli._app import GROUPS, names
from torch_ekm.experiments.reporting.report import FigureFile, Report, Table
from torch_ekm.experiments.reproduce import PROTOCOLS, plan
from torch_ekm.plant import Trajectory, TrialLog

COMMANDS = typer.main.get_command(app).commands


def said(text: str) -> str:
    """Without line breaks and hyphenation, which depend on the width of a terminal."""
    return re.sub(r"[\s\b]+", "", text)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_tells_all_of_every_option(name: str) -> None:
    shown = CliRunner().invoke(app, [name, "--help"])
    assert shown.exit_code == 0, shown.output
    for parameter in COMMANDS[name].params:
        assert said(parameter.help or "") in said(shown.output), parameter.name
    assert said(COMMANDS[name].help) in said(shown.output)


def test_python_runs_the_package_as_the_command(monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.argv", ["torch-ekm", "hands"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("torch_ekm.cli", run_name="__main__")
    assert end.value.code == 0
    assert "yale_t42" in capsys.readouterr().out


def test_a_warning_is_a_note_without_a_path(monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.argv", ["torch-ekm", "--version"])
    with pytest.raises(SystemExit):
        main()
    capsys.readouterr()
    warnings.showwarning(UserWarning("loops are compiled"), UserWarning, "/a/path.py", 1)
    assert capsys.readouterr().err == "Note:      loops are compiled\n"


def test_how_long_it_takes_is_said_before_the_first_job_has_ended(capsys) -> None:
    with progress("turning", 8, 130.0):
        assert "8 to do, some 2 min on free cores" in capsys.readouterr().out


def test_the_help_tells_how_much_there_is_to_run() -> None:
    text = COMMANDS["reproduce"].help
    for name in PROTOCOLS:
        assert re.search(rf"{name} +{len(plan(name).jobs)} ", text), name


def test_figures_with_their_intervals_are_not_broken_over_lines() -> None:
    text = "The E-KM ends 0.10 [0.07, 0.12] deg from the target, KM+S 101 [99, 107] % of that."
    for width in range(20, 90):
        lines = unbroken(text, width).split("\n")
        assert " ".join(lines) == text
        for figure in ("0.10 [0.07, 0.12] deg", "101 [99, 107] %"):
            assert sum(figure in line for line in lines) == 1


@pytest.mark.parametrize("width", [60, 100])
def test_a_table_that_is_too_wide_is_printed_in_parts(width, monkeypatch, capsys):
    import torch_ekm._terminal as terminal

    monkeypatch.setattr(terminal, "console", Console(markup=False, force_terminal=True, width=width))
    cells = [["box", *(f"0.{k}1 [0.01, 0.99]" for k in range(9))], ["can", *["-"] * 9]]
    print_table(["object", *(f"error {k} [deg]" for k in range(9))], cells, "Title", "Note")
    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert printed.count("box") == printed.count("can") > 1
    assert printed.count("Title") == printed.count("Note") == 1
    for k in range(9):
        assert printed.count(f"0.{k}1 [0.01, 0.99]") == printed.count(f"error {k} [deg]") == 1
    assert max(map(len, printed.splitlines())) <= width


def test_units_of_a_table_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    shown = CliRunner().invoke(app, ["objects"])
    assert "mass [g]" in shown.output
    assert "grasp width [mm]" in shown.output
    table = Table(
        "errors", "Errors [deg]", ["case", "KM [deg]"], [["box", "0.5 [0.4, 0.6]"]], "per turn [deg]"
    )
    print_report(Report("", "", [table]), Path(), notes=True)
    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    for text in ("Errors [deg]", "KM [deg]", "0.5 [0.4, 0.6]", "per turn [deg]"):
        assert text in printed


def test_the_terminal_has_the_answer_the_first_table_and_the_path(capsys, tmp_path):
    tables = [Table(name, f"Caption {name}", ["case"], [["a" * 20]]) for name in ("one", "two")]
    print_report(Report("Title", "The answer.", tables), tmp_path)
    printed = capsys.readouterr().out
    assert printed.startswith("The answer.")
    assert "Caption one" in printed
    assert "Caption two" not in printed
    assert str(tmp_path / "index.html") in printed


HOSTILE = "\x1b]0;owned\x07 \x1b[31m[red]x[/] \u202egnp \x9b2J \ud800"


def test_text_of_a_file_is_no_command_to_the_terminal(capsys, monkeypatch, tmp_path):
    assert as_printed("0.5 ± 0.1 µm\n[deg]") == "0.5 ± 0.1 µm\n[deg]"
    print_report(Report("", HOSTILE, [Table("t", HOSTILE, [HOSTILE], [[HOSTILE]], HOSTILE)]), tmp_path, True)
    (tmp_path / "hand.urdf").write_text(f'<robot><link name="{HOSTILE[1:8]}&#x9b;2J[/]\\"/></robot>')
    monkeypatch.setattr("sys.argv", ["torch-ekm", "show", str(tmp_path / "hand.urdf")])
    with pytest.raises(SystemExit):
        main()
    printed = "".join(capsys.readouterr())
    assert printed.count("[red]x[/]") == 5
    assert not {"\x1b", "\x07", "\x9b", "\u202e", "\ud800"} & {*printed}


def test_verify(tmp_path: Path) -> None:
    with TrialLog(tmp_path, {}) as log:
        log.write(0, Trajectory(), {"reason": HOSTILE})
    right = CliRunner().invoke(app, ["verify", str(tmp_path)])
    assert right.exit_code == 0, right.output
    assert "\x1b" not in right.output
    (tmp_path / "trial_000000.h5").write_text("")
    wrong = CliRunner().invoke(app, ["verify", str(tmp_path)])
    assert wrong.exit_code == 1
    assert re.search(r"trial_000000\.h5.*wrong", wrong.output)


def test_a_page_begins_with_the_answer_and_folds_the_rest(tmp_path: Path) -> None:
    tables = [
        Table(name, f"Caption {name}", ["case", "error [deg]"], [["a", "-"]]) for name in ("one", "two")
    ]
    figure, legend = FigureFile("a.svg", "What to see"), {"E-KM": "with a learner"}
    report = Report("Title", "Ends 0.1 [0.0, 0.2] deg off.", tables, [figure], leading=1, legend=legend)
    page = report.write(tmp_path).read_text()
    order = (
        "Ends ",
        "with a learner",
        "Caption one</caption>",
        "a.svg",
        "<details>",
        "Caption two</caption>",
    )
    places = [page.index(part) for part in order]
    assert places == sorted(places)


def test_every_command_stands_in_a_group_with_a_whole_sentence() -> None:
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(
        typer.main.get_command(app).commands
    )
    told = CliRunner().invoke(app, ["--help"]).output
    assert all(title in told for title in GROUPS)
    assert "Find dead zone and bias of each motor of a real hand, by motions of 0.4 to 2 deg." in " ".join(
        told.split()
    )
    assert "..." not in told.replace("[ARGS]...", "")


def test_columns_that_look_like_measured_and_predicted_are_proposed(tmp_path: Path) -> None:
    table = tmp_path / "log.csv"
    table.write_text("angle,torque,model_torque\n" + "0.1,1.0,0.9\n" * 50)
    done = CliRunner().invoke(app, ["compare", "--data", str(table), "--jobs", "1"])
    assert "--measured torque --predicted model_torque" in str(done.exception)

    table.write_text("angle,torque\n" + "0.1,1.0\n" * 50)
    done = CliRunner().invoke(app, ["compare", "--data", str(table), "--jobs", "1"])
    assert "--measured torque" not in str(done.exception)


def test_names_of_columns_may_have_blanks_units_and_commas(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text('u,tau meas [Nm],tau sim [Nm],"q, deg"\n' + "1,2,2.1,3\n" * 50)
    done = CliRunner().invoke(app, ["compare", "--data", str(path), "--jobs", "1"])
    assert "--measured 'tau meas [Nm]' --predicted 'tau sim [Nm]'" in str(done.exception)
    assert names('u, "q, deg", u') == ("u", "q, deg")
    done = CliRunner().invoke(app, ["compare", "--data", str(path), "--jobs", "1", "--measured", "q"])
    assert '"q, deg"' in str(done.exception)
