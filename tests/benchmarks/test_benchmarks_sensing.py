"""The paper's sensing, in simulation: the lens, its calibration, what is counted, and that it runs."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("sensing", reason="the benchmarks are not part of this installation")
pytest.importorskip("cv2")

import sensing
from simulated_hand.lens import DATASHEET, LENSES, DistortingCamera, calibrated, lens_of
from simulated_hand.tracking_accuracy import measure_tracking


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


def test_a_quick_run_prints_its_verdict(tmp_path: Path, monkeypatch, capsys) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setattr(sensing, "calibrated", partial(calibrated, views=5))
    monkeypatch.setitem(LENSES, "20 pictures", LENSES["5 pictures"])
    sensing.main(["--quick", "--seeds", "1:2", "--jobs", "1", "--out", str(tmp_path)])
    told = capsys.readouterr().out
    assert told.splitlines()[-1].startswith("all sensed lost 0 of 1, reached 1")
    rows = {
        line.split(" | ")[0][2:]: line.split(" | ")[1:] for line in told.splitlines() if line.startswith("| ")
    }
    assert 0.05 < float(rows["all sensed"][5]) < 2.0  # [deg] of joints
    assert float(rows["true joint angles"][5]) == 0.0
    assert 0.01 < float(rows["all sensed"][6].rstrip(" |")) < 3.0  # [deg] of motors
    assert 0.1 < float(rows["index_1"][0]) < 1.0  # [deg] Hall fit
    assert float(rows["exact"][1]) <= float(rows["20 pictures"][1]) < float(rows["not calibrated"][1])
