"""The main job, small: the loop closes, learns, reports, resumes, and fails clearly."""

import dataclasses
import json
from pathlib import Path

import pytest
from made_up_sessions import made_up_turn

from torch_ekm.control import Safety, StoppingRule
from torch_ekm.exceptions import UnknownNameError
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.jobs import read_result
from torch_ekm.experiments.protocols.demo import Demo, new_table
from torch_ekm.experiments.records import TrialRecord
from torch_ekm.experiments.reporting.report import Report
from torch_ekm.experiments.reporting.statistics import trial_frame
from torch_ekm.experiments.reproduce import Experiment, reproduce
from torch_ekm.experiments.runner import Bench
from torch_ekm.model import ModelOptions

#: The dead zone stops a plain KM: it would go on for 30 motions until it is said to stall.
BRIEF = Setting(engine="mujoco", safety=Safety(rule=StoppingRule(max_steps=16)))
EXPERIMENT = Experiment(Demo(BRIEF, angles_deg=(9.0, 14.0), new=()), (1,))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def report(folder: Path) -> Report:
    return reproduce(EXPERIMENT, folder)


@pytest.fixture(scope="module")
def records(report: Report, folder: Path) -> list[TrialRecord]:
    kept = [read_result(path, path.stem) for path in sorted((folder / "runs").glob("*.json"))]
    return [TrialRecord.from_json(figures) for session in kept for figures in session]


def test_every_target_is_approached_and_reached_by_the_enhanced_model(records: list[TrialRecord]) -> None:
    assert len(records) == 4
    for record in records:
        assert not record.lost
        # the dead zone stops a plain KM
        assert record.true_error_deg < (1.5 if record.controller == "KM" else 0.5), record.reason
        assert record.steps > 2


def test_enhanced_model_predicts_better_than_the_kinematic_model(report: Report) -> None:
    table = next(table for table in report.tables if table.name == "controllers")
    row = dict(zip(table.header, table.rows[-1], strict=True))
    assert row["E-KM, one motion [deg]"].mean < 0.8 * row["KM, one motion [deg]"].mean


def test_report_is_complete_and_says_how_it_was_made(report: Report, folder: Path) -> None:
    page = (folder / "index.html").read_text()
    for name in (
        "by_angle.csv",
        "controllers.csv",
        "prediction_error.svg",
        "steady_state_error.svg",
        "hand.png",
        "animation.html",
        "configuration.json",
    ):
        assert (folder / name).stat().st_size > 100, name
    for figure in report.figures:
        assert figure.path in page
    configuration = json.loads((folder / "configuration.json").read_text())
    assert configuration["experiment"]["objects"] == ["box"]
    by_angle = next(table for table in report.tables if table.name == "by_angle")
    assert [row[0] for row in by_angle.rows] == ["9", "14", "all"]


def test_the_first_hand_turns_objects_that_it_has_never_held() -> None:
    jobs = Demo(BRIEF, new=("box", "can")).jobs((3, 4))
    new = {name: job for name, job in jobs.items() if name.startswith("new_")}
    assert [*new.values()] == [(("box", "can"), name, 3) for name in ("KM", "E-KM")]
    assert jobs.keys() - new == Demo(BRIEF, new=()).jobs((3, 4)).keys()
    assert Demo(BRIEF).quick().jobs((3,)).keys().isdisjoint(new)


def test_new_objects_are_told_apart_from_the_turns_that_are_tested() -> None:
    made = [made_up_turn(name, 3, k, 9.0, "can") for name in ("KM", "E-KM") for k in range(2)]
    new = [dataclasses.replace(one, kind="new") for one in made]
    told = new_table(trial_frame({"a": new, "b": [made_up_turn("KM", 3, 5, 9.0, "box")]}))
    assert [row[0] for row in told.rows] == ["can", "all"]
    row = dict(zip(told.header, told.rows[0], strict=True))
    for name, mine in (("KM", new[:2]), ("E-KM", new[2:])):
        error, motions = (
            sum(of) / 2 for of in zip(*((one.true_error_deg, one.steps) for one in mine), strict=True)
        )
        assert row[name] == f"{error:.2f}; {motions:.1f}"


def test_results_are_named_by_the_model_that_is_run() -> None:
    demo = Demo()
    bench = Bench(demo.setting, demo.object, "E-KM")
    assert bench.model.options.contact_margin == demo.setting.figures()["model"]["contact_margin"]
    bench.close()
    names = set(demo.jobs((0,)))
    assert names.isdisjoint(Demo(Setting(model=ModelOptions(contact_margin=0.003))).jobs((0,)))


def test_wrong_names_list_the_right_ones() -> None:
    with pytest.raises(UnknownNameError, match="weighted_box"):
        Demo(objects=("spoon",))
    with pytest.raises(UnknownNameError, match="KM\\+I"):
        Demo(controllers=("PID",))
    with pytest.raises(UnknownNameError, match="E-KM"):
        EXPERIMENT.protocol.session("box", "PID", 0)
