"""reproduce: plans, reports, resume after a kill, and the command line."""

import csv
import functools
import html
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_up_sessions import made_up_generalize, made_up_online, turn
from typer.testing import CliRunner

from torch_ekm.cli import app
from torch_ekm.description.registry import object_paths
from torch_ekm.exceptions import DescriptionError, ParameterError, UnknownNameError
from torch_ekm.experiments.protocols.demo import Demo
from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.protocols.online import Online
from torch_ekm.experiments.reporting.report import Report
from torch_ekm.experiments.reproduce import PROTOCOLS, plan, reproduce


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sessions without a simulation."""
    monkeypatch.setattr(Online, "session", made_up_online)
    monkeypatch.setattr(Generalize, "session", made_up_generalize)


@pytest.fixture(scope="module")
def reports(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Report, Path]]:
    """A protocol's report of three seeds and its folder, made once; with ``made_up``."""

    @functools.cache
    def report(name: str) -> tuple[Report, Path]:
        folder = tmp_path_factory.mktemp(name)
        return reproduce(plan(name, (0, 1, 2)), folder), folder

    return report


def read(folder: Path) -> dict[str, bytes]:
    """The report: all that is not kept of single jobs."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.usefixtures("made_up")
@pytest.mark.parametrize("name", PROTOCOLS)
def test_report_is_complete(name: str, reports: Callable[[str], tuple[Report, Path]]) -> None:
    report, folder = reports(name)
    page = (folder / "index.html").read_text()
    for table in report.tables:
        with (folder / f"{table.name}.csv").open() as stream:
            rows = list(csv.reader(stream))
        assert rows[0] == list(table.header)
        assert len(rows) == len(table.rows) + 1 > 1, table.name
        assert all(len(row) == len(rows[0]) for row in rows), table.name
        assert table.caption in html.unescape(page)
        assert rows[1:] == table.text()
    cells = [cell for table in report.tables for row in table.rows for cell in row]
    assert not any(isinstance(cell, float) and np.isnan(cell) for cell in cells)
    for figure in report.figures:
        assert (folder / figure.path).stat().st_size > 1000
    configuration = json.loads((folder / "configuration.json").read_text())
    assert configuration["seeds"] == [0, 1, 2]
    assert configuration["versions"]["torch"]
    assert configuration["plant"]["dead_zone"] > 0
    assert "Development seeds" in report.summary
    assert "not tested" in report.summary


def test_a_hand_that_cannot_be_modelled_gives_the_reason_alone_and_ends_with_1(tmp_path, monkeypatch):
    ended = {"reason": "unstable grasp", "message": "two hard fingers", "seconds": (), "errors_deg": (9.0,)}
    monkeypatch.setattr(Demo, "session", lambda _, item, name, seed: [turn(name, seed, 9.0, **ended)])
    out = tmp_path / "demo"
    shown = CliRunner().invoke(app, ["demo", "--seeds", "1:3", "--jobs", "1", "--out", str(out)])
    assert shown.exit_code == 1, shown.output
    said = " ".join(shown.output.split())
    assert "Nothing was turned. 6 of 6 turns ended with 'unstable grasp': two hard fingers." in said
    assert "%" not in shown.output
    assert not list(out.glob("comparison.csv"))


@pytest.mark.usefixtures("made_up")
def test_a_quick_report_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)  # of its words alone
    quick = reproduce(plan("online", (0, 1), quick=True), tmp_path / "quick")
    whole = reproduce(plan("online", (0, 1)), tmp_path / "whole")
    assert quick.title == f"{whole.title}: a quick run"
    assert quick.summary.startswith("A quick run shows that it works, and claims nothing.")
    assert "quick" not in whole.summary


@pytest.mark.usefixtures("made_up")
def test_killed_run_resumes_to_the_same_report(tmp_path, reports):
    (_, whole), broken = reports("generalize"), tmp_path / "broken"
    experiment = plan("generalize", (0, 1, 2))
    done: list[str] = []

    def kill(name: str) -> None:
        done.append(name)
        if len(done) == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reproduce(experiment, broken, on_done=kill)
    half = {path.name: path.stat().st_mtime_ns for path in (broken / "runs").glob("*.json")}
    assert len(half) == 7
    assert not (broken / "index.html").exists()
    reproduce(experiment, broken)
    after = {path.name: path.stat().st_mtime_ns for path in (broken / "runs").glob("*.json")}
    assert {name: after[name] for name in half} == half  # nothing was run twice
    assert read(broken) == read(whole)
    assert {path.suffix for path in whole.iterdir()} >= {".csv", ".html", ".json", ".svg"}


def test_objects_of_a_user(tmp_path: Path) -> None:
    for name, like in (("mug", "can"), ("pen", "toothpaste")):
        for source, suffix in zip(object_paths(like), (".urdf", ".object.toml"), strict=True):
            (tmp_path / (name + suffix)).write_bytes(source.read_bytes())
    own = [str(tmp_path / f"{name}.urdf") for name in ("mug", "pen")]
    assert any("_mug_E-KM_0" in name for name in plan("generalize", (0,), objects=own).jobs)
    (tmp_path / "pen.object.toml").unlink()
    with pytest.raises(DescriptionError, match=r"pen\.object\.toml"):  # before anything runs
        plan("generalize", (0,), objects=own)


def test_plans_are_checked() -> None:
    with pytest.raises(UnknownNameError, match="online"):
        plan("offline")
    with pytest.raises(ParameterError, match="seeds"):
        plan("online", ())
    for name in PROTOCOLS:
        assert len(plan(name, quick=True).jobs) < len(plan(name).jobs)
