"""The report on foresight: one small session, and what is made of figures."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import foresight_report as report
import pytest
from foresight_study import CONTENDERS, Foresight
from foresight_turn import ForesightTurn
from oracle import Omniscient

from torch_ekm.control import Safety, StoppingRule
from torch_ekm.exceptions import ParameterError
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.reporting.trials import trial_frame
from torch_ekm.experiments.reproduce import Experiment, reproduce

pytest.importorskip("sapien")

COARSE = Safety(rule=StoppingRule(tolerance=math.radians(0.5)))
QUICK = dataclasses.replace(
    Foresight(Setting(safety=COARSE)).quick(), warm_up=0, far_deg=8.0, blind_angle_deg=5.0
)


def test_a_session_says_what_was_predicted_and_what_came(tmp_path: Path) -> None:
    made = reproduce(Experiment(QUICK, (0,)), tmp_path)
    (session,) = (tmp_path / "runs").glob("*.json")
    records = {r.kind: r for r in map(ForesightTurn.from_json, json.loads(session.read_text())["result"])}
    assert list(records) == ["blind", "blind, looks again", "blind, no touch", "far"]
    far, dark, alone = (records[kind] for kind in ("far", "blind", "blind, no touch"))
    assert isinstance(far, ForesightTurn)
    assert isinstance(dark, ForesightTurn)
    assert isinstance(alone, ForesightTurn)
    assert far.reach_end == "nothing"
    assert far.largest_deg == pytest.approx(8.0, abs=1.5)
    assert far.axis_std_deg is None
    assert dark.reach_deg is None
    assert dark.axis_std_deg is not None
    assert dark.estimate_error_deg is not None
    assert alone.axis_std_deg is not None
    assert 0.05 < dark.axis_std_deg < alone.axis_std_deg
    assert abs(dark.estimate_error_deg) < 3 * dark.axis_std_deg
    assert dark.looks == 0
    names = [table.name for table in made.tables]
    assert names[:2] == ["far", "blind"]  # nothing ended, so nothing was predicted of an end
    assert "blind turn of 5 deg" in made.summary


def test_contenders_are_what_they_are_called() -> None:
    for name, (make, controller) in CONTENDERS.items():
        bench = make(Setting(), "box", controller)
        assert bench.learns == name.endswith("E-KM")
        assert isinstance(bench.plant, Omniscient) == (name == "oracle")


def turn(**figures) -> ForesightTurn:
    about = dict.fromkeys(
        ("errors_deg", "prediction_km_deg", "prediction_ekm_deg", "true_prediction_km_deg", "seconds"), ()
    )
    known = {
        "object": "box", "kind": "far", "controller": "E-KM", "seed": 0, "trial": 0, "angle_deg": 70.0,
        "reason": "given up", "message": "", "true_error_deg": 1.0, "first_step_deg": None,
        "step_error_deg": None, "true_prediction_ekm_deg": (), "off_rotation_deg": 0.0,
        "contender": report.PLANNED,
    }  # fmt: skip
    return ForesightTurn(**{**about, **known, **figures})


def test_what_is_made_of_the_figures() -> None:
    turns = [
        turn(largest_deg=30.0, reach_deg=31.5, reach_end="link: thumb_2"),
        turn(largest_deg=20.0, reach_deg=14.0, reach_end="friction", seed=1),
        turn(largest_deg=70.0, reach_deg=70.0, reach_end="nothing", reason="reached", seed=2),
    ]
    trials = trial_frame({"a": turns}, 60)
    assert report.reach_errors(trials).tolist() == [1.5, -6.0]
    assert report.declined(trials.assign(angle_deg=33.0)).tolist() == [False, True, False]
    further = [turn(contender="another", largest_deg=1.5 * t.largest_deg, seed=t.seed) for t in turns]
    both = trial_frame({"a": [*turns, *further]}, 60)
    assert report.paired_ratio(both, "another") == pytest.approx(1.5)
    nearer = [
        turn(contender="oracle", largest_deg=t.largest_deg + d, seed=t.seed)
        for t, d in zip(turns, (-1.9, 3.0, 0.5), strict=True)
    ]
    rows = {row[0]: row for row in report.far_table(trial_frame({"a": [*turns, *nearer]}, 60)).rows}
    assert (rows["oracle"][4].count, rows["oracle"][4].n, rows[report.PLANNED][4]) == (2, 3, None)
    met = {target.what: target for target in report.foresight_targets(both)}
    assert met["reach predicted within 2 deg [% of grasps]"].measured == 50
    blind = [turn(estimate_error_deg=e, axis_std_deg=0.3) for e in (0.1, -0.45, 0.6)]
    assert report.covered(trial_frame({"a": blind}, 60)).tolist() == [True, True, False]


def test_impossible_protocols_are_refused() -> None:
    impossible: list[dict[str, Any]] = [
        {"objects": ()}, {"contenders": ("PID",)}, {"look_again_deg": 0.0}, {"blind_angle_deg": math.inf},
    ]  # fmt: skip
    for wrong in impossible:
        with pytest.raises(ParameterError):
            Foresight(**wrong)
