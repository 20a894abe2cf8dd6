"""The main job, small: the loop closes, learns, reports, resumes, and fails clearly."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from torch_ekm.cli import app, parse_seeds
from torch_ekm.exceptions import ParameterError, UnknownNameError
from torch_ekm.experiments.protocols.demo import DemoConfig, run_session
from torch_ekm.experiments.protocols.demo_report import prediction_estimates, run_demo

CONFIG = DemoConfig(seeds=(0, 1), angles_deg=(9.0, 14.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("demo")
    run_demo(CONFIG, path, pictures=False)
    return path


def records(folder: Path) -> list[dict]:
    return [r for path in sorted((folder / "runs").glob("*.json")) for r in json.loads(path.read_text())]


def test_every_target_is_reached_by_both_controllers(folder: Path) -> None:
    found = records(folder)
    assert len(found) == 8
    for record in found:
        assert not record["lost"]
        assert record["true_error_deg"] < 1.0, record["reason"]
        assert record["steps"] > 2


def test_enhanced_model_predicts_better_than_the_kinematic_model(folder: Path) -> None:
    km, ekm = prediction_estimates(records(folder))
    assert ekm.mean < 0.8 * km.mean


def test_untrained_first_step_is_the_kinematic_models(folder: Path) -> None:
    first = next(r for r in records(folder) if r["controller"] == "E-KM" and r["angle_deg"] == 9.0)
    assert first["prediction_ekm_deg"][0] == first["prediction_km_deg"][0]
    assert first["prediction_ekm_deg"][1] != first["prediction_km_deg"][1]


def test_report_is_complete_and_says_how_it_was_made(folder: Path) -> None:
    page = (folder / "index.html").read_text()
    for name in (
        "summary.csv",
        "by_angle.csv",
        "prediction_error.svg",
        "steady_state_error.png",
        "configuration.json",
    ):
        assert (folder / name).stat().st_size > 100, name
    assert "prediction_error.svg" in page
    assert "development seeds" in page  # seeds below 1000 are not for claims
    configuration = json.loads((folder / "configuration.json").read_text())
    assert configuration["demo"]["seeds"] == [0, 1]
    assert configuration["versions"]["torch"]


def test_same_seed_same_run_and_resume(folder: Path) -> None:
    again = run_session(CONFIG, "E-KM", 0)
    kept = [r for r in records(folder) if r["controller"] == "E-KM" and r["seed"] == 0]
    for new, old in zip(again, kept, strict=True):
        assert new["errors_deg"] == old["errors_deg"]
        np.testing.assert_array_equal(new["frames"][-1][0], old["frames"][-1][0])
    before = {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()}
    run_demo(CONFIG, folder, pictures=False)
    assert {path: path.stat().st_mtime_ns for path in (folder / "runs").iterdir()} == before


def test_wrong_names_list_the_right_ones() -> None:
    with pytest.raises(UnknownNameError, match="weighted_box"):
        DemoConfig(object="spoon")
    with pytest.raises(UnknownNameError, match="icub_left"):
        DemoConfig(hand="icub")
    with pytest.raises(ParameterError, match="angles_deg"):
        DemoConfig(angles_deg=(200.0,))
    with pytest.raises(UnknownNameError, match="E-KM"):
        run_session(CONFIG, "PID", 0)


@pytest.mark.parametrize("command", [["--help"], ["demo", "--help"], ["hands"], ["objects"], ["version"]])
def test_command_line_explains_itself(command: list[str]) -> None:
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert len(result.output) > 50


def test_seeds_are_parsed() -> None:
    assert parse_seeds("1000:1003") == (1000, 1001, 1002)
    assert parse_seeds("7") == (7,)
    for text in ("a", "3:1", "1:2:3", ""):
        with pytest.raises(ParameterError, match="FIRST:END"):
            parse_seeds(text)
