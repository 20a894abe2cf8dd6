"""The paper's sensing, in simulation: the lens, its calibration, what is counted, and that it runs."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sensing", reason="the benchmarks are not part of this installation")
pytest.importorskip("cv2")

import sensing
from simulated_hand.lens import DATASHEET, LENSES, DistortingCamera, calibrated, lens_of
from simulated_hand.sensing_report import Outcome, Turn
from simulated_hand.tracking_accuracy import measure_tracking


def turn(controller: str, error: float, **other) -> Turn:
    usual = {"readings": "all sensed", "object": "box", "seed": 0, "angle": 9.0, "lost": False, "motions": 5}
    motions = {"one_step": [0.3, 0.4], "one_step_km": [1.0, 1.0], "motors": [0.5, -1.5]}
    read = {"joints": [[1.0, 2.0], [1.0, -2.0]], "rotation": [0.1], "position": [0.2]}
    return Turn(controller=controller, error=error, reached=True, **{**usual, **motions, **read, **other})


def test_each_pixel_looks_where_the_lens_projects_to_it() -> None:
    for seed in range(3):
        lens, camera = lens_of(seed), DistortingCamera(lens_of(seed))
        rays = (camera._where - [camera.camera.cx, camera.camera.cy]) / camera.camera.fx
        seen = lens.project(np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1))
        v, u = (np.mgrid[:960, :1280] + 0.5) / 2 - 0.5
        np.testing.assert_allclose(seen, np.stack([u, v], axis=-1), atol=1e-3)
        assert 0 < camera._where.min() < camera._where[..., 1].max() < camera.camera.height


def test_a_few_pictures_of_the_board_bring_depth_back() -> None:
    lens = lens_of(1)
    found = calibrated(1, 5)
    assert found.views == 5
    assert found.reprojection < 0.1
    assert abs(found.camera.fx / lens.fx - 1) < 5e-3 < abs(DATASHEET.fx / lens.fx - 1)
    camera = DistortingCamera(lens)
    exact, few, wrong = (measure_tracking(10, 1, camera, known) for known in (lens, found.camera, DATASHEET))
    assert exact.depth_mm < 0.2
    assert exact.depth_mm <= few.depth_mm < 3.0 < wrong.depth_mm


def test_figures_are_those_of_the_turns() -> None:
    turns = [turn("E-KM", 0.1), turn("E-KM", 5.0, lost=True), turn("KM", 2.0)]
    hall = [{"joint": "a", "rms": 3.0, "largest": 6.0, "blind": 0.1, "stated": 3.0, "misfit": 1.0}]
    figures = {"focal": 1.0, "axis": 1.0, "depth": 2.0, "position": 1.0, "rotation": 1.0}
    lenses = [{"known": dict.fromkeys(LENSES, figures), "reprojection": 0.1}]
    steps = [{"s": 0.5, "error": 0.3, "sd": 0.2}] * 5
    ends = [
        {"error": error, "motions": 2, "lost": lost, "reason": "reached"} for error, lost in ((1, 0), (9, 1))
    ]
    blind = [{"by": "touch", "object": "box", "seed": 0, "motions": steps, "turns": ends}]
    outcome = Outcome(hall, lenses, turns, blind, ("a", "b"))
    rows = {row[0]: row[1:] for row in outcome.paper_table().text()}
    assert rows["Hall fit over a sweep: rms, largest"][1] == "3.00, 6.0 deg"
    assert rows["joints in turns: with, without Hall sensor"][1] == "1.00, 2.00 deg"
    assert rows["position controller: rms, within 1 deg"] == ["±1 deg", "1.12 deg, 50 %"]
    assert rows["one motion's prediction: KM, E-KM"][1] == "1.00, 0.35 deg"
    assert rows["end of a turn: KM, E-KM"] == ["box 2.8, 0.8 deg", "box 2.0, 0.1 deg"]
    assert rows["a blind turn of 15 deg: median, largest"][1] == "1.00, 1.00 deg"
    assert outcome.turn_table().text()[0][:5] == ["E-KM, all sensed", "2 of 2", "1", "5.0", "0.10"]
    assert outcome.blind_table().text()[1] == ["touch, later turns", "1", "1", "1", "-", "-"]
    assert [row[:2] for row in outcome.time_table().text()] == [["1", "0.5"], ["5", "0.5"]]
    outcome.picture()


def test_a_quick_run_prints_its_verdict_and_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(sensing, "WARM_UP", ())
    monkeypatch.setattr(sensing, "ANGLES", (5.0,))
    monkeypatch.setattr(sensing, "calibrated", partial(calibrated, views=5))
    monkeypatch.setitem(LENSES, "20 pictures", LENSES["5 pictures"])
    words = ["--quick", "--seeds", "1:2", "--out", str(tmp_path)]
    sensing.main(words)
    first = capsys.readouterr().out.splitlines()[-1]
    assert first.startswith("Hall fit 0.")
    assert (tmp_path / "sensing.svg").exists()
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*_1.json")}
    assert len(kept) == 4
    turns, blind = (
        json.loads(next(tmp_path.glob(f"{part}_*.json")).read_text())["result"] for part in ("turns", "blind")
    )
    errors = np.array(turns[0]["joints"])
    assert 0.05 < np.sqrt(np.mean(errors[:, 1:4] ** 2)) < 2.0  # [deg] of Hall sensors
    assert len(errors) == turns[0]["motions"] + 1 == len(turns[0]["position"])
    assert 0.01 < np.abs(turns[0]["motors"]).max() < 3.0
    assert max(turns[0]["position"]) < 1.0
    sighted, touch, _ = (one["motions"] for one in blind)
    assert all(at["sd"] is None for at in sighted)
    assert 0 < touch[0]["sd"] < touch[-1]["sd"] < 1.0
    assert max(abs(at["error"]) for at in sighted) < 0.3
    assert np.diff([0.0, *(at["s"] for at in touch)]).min() > 0.1
    sensing.main(words)
    assert capsys.readouterr().out.splitlines()[-1] == first
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
