"""The grid of conditions: its cells, what it counts, and that it runs."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("grid", reason="the benchmarks are not part of this installation")

import grid
from grid import FRICTION, MASS, Grid, cells

from torch_ekm.experiments.records import TrialRecord


def record(reason: str, error: float, angle: float = 9.0) -> TrialRecord:
    return TrialRecord(
        "box", "turn", "E-KM", 0, 1, angle, reason, "", error, (angle, error), 0.1, 0.1, (), (), (), (), 0.0,
        (0.01,) * 5,
    )  # fmt: skip


def test_every_cell_is_a_hand_of_its_own() -> None:
    found = cells("mujoco")
    assert len(found) == len(FRICTION) * len(MASS) + 2 + 4 + 1 + 1
    figures = [(one.hand, one.parameters, one.config) for one in found.values()]
    assert all(figures.count(one) == 1 for one in figures)
    assert found["friction 0.4, mass 3"].parameters.friction == 0.4
    assert found["left hand"].hand == "icub_left"
    assert found["fingers down"].plant_config("E-KM").gravity == (9.81, 0.0, 0.0)
    assert found["centred grasps"].plant_config("KM+I").spread == 0


def test_cells_are_counted_and_drawn(tmp_path: Path) -> None:
    cell = "friction 0.4, mass 3"
    ours = [record("reached", 0.1), record("object lost", 50.0, 19.0)]
    theirs = [record("reached", 0.2), record("stalled", 0.6)]
    made = Grid({(cell, "E-KM"): ours, (cell, "KM+I"): theirs, ("left hand", "E-KM"): ours[:1]})
    verdict = "E-KM lost 1 of 3, reached 2, error 6.40 deg; KM+I lost 0, reached 1, error 0.40 deg"
    assert made.verdict == verdict
    assert made.table().text()[0] == [cell, "2", "1", "1", "9.55", "0", "1", "0.40"]
    assert made.ends().text() == [[cell, "1 object lost", "1 stalled"]]
    report = made.report(tmp_path, "mujoco")
    assert verdict in report.summary
    assert (tmp_path / "grid_mujoco.svg").exists()


def test_it_runs_and_what_is_done_is_kept(tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(grid, "ANGLES", (4.0,))
    monkeypatch.setattr(grid, "WARM_UP", 0)
    grid.main(["--quick", "--jobs", "1", "--out", str(tmp_path)])
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("E-KM lost 0 of 1, reached 1, error 0.")
    kept = {path: path.stat().st_mtime_ns for path in tmp_path.glob("centred_grasps_box_*.json")}
    assert len(kept) == 2
    grid.main(["--quick", "--jobs", "1", "--out", str(tmp_path)])
    assert capsys.readouterr().out.splitlines()[-1] == last
    assert kept == {path: path.stat().st_mtime_ns for path in kept}
    with pytest.raises(SystemExit):
        grid.main(["--cells", "nowhere"])
