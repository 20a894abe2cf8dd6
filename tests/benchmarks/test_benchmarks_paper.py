"""Page of the paper's figures and tables: numbers are those of the runs, or a row says what measures them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("paper", reason="the benchmarks are not part of this installation")

from paper_overview import RATIOS
from paper_pictures import Coupled, FarTurn, _cropped, largest_difference

from paper import Objects, mean_text, table_ii, tables_of
from torch_ekm.experiments.protocols.generalize import TABLE_II
from torch_ekm.experiments.reporting.report import Column, Report, Table
from torch_ekm.experiments.reporting.statistics import Estimate

RUN = [
    Table(
        "paper",
        "The paper's Table II, and the same here",
        ["object", "KM, here [deg]", "E-KM, here [deg]", Column("E-KM:KM, here [%]", ".0f", percent=True)],
        [
            ["weighted_box", Estimate(1.0, 0.9, 1.1, 10), Estimate(0.1, 0.05, 0.2, 10), 0.1],
            ["box", Estimate(2.0, 1.9, 2.1, 10), Estimate(0.4, 0.3, 0.5, 10), 0.2],
        ],
        "A note.",
    ),
    Table(
        "ends",
        "Objects lost, and turns that did not reach the target",
        ["object", "KM lost, not reached", "E-KM lost, not reached"],
        [[item, "9, 9", f"{k}, {2 * k}"] for k, item in enumerate(TABLE_II)],
    ),
    Table(
        "cells",
        "Each object and target (the paper's Fig. 6)",
        ["object", "trial 1", "trial 2"],
        [["box", "9: 0.75, 0.13, 8 of 10", None], ["can", "9: 0.50, 0.04, 10 of 10", "13: 0.40, 0.41, 1|3"]],
    ),
]


@pytest.fixture(params=["folder", "page"])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Objects:
    """The same tables from the folder of a report, and from a page made of it."""
    report = Report("Title", "An answer.", RUN)
    report.write(tmp_path / "report")
    source = tmp_path / "report"
    if request.param == "page":
        source = tmp_path / "page.md"
        source.write_text(report.markdown(), encoding="utf-8")
    return Objects(tables_of(source), "measure")


def test_numbers_are_those_of_the_run(run: Objects) -> None:
    assert run.table_ii("box") == "2.00 [1.90, 2.10]; 0.40 [0.30, 0.50]; 20 %"  # not the weighted box's
    assert run.errors == {"weighted_box": (1.0, 0.1), "box": (2.0, 0.4)}
    assert run.ends() == "the same; E-KM: 10 lost, 20 not reached"
    assert run.cells() == [("box", 0.75, 0.13), ("can", 0.5, 0.04), ("can", 0.4, 0.41)]


def test_table_ii_has_a_row_for_each_object_its_mean_and_the_system_as_printed(run: Objects) -> None:
    rows = table_ii(
        {"generalize": run, "worn": Objects({}, "wear"), "as_printed": Objects({}, "print")}
    ).text()
    assert rows[1] == ["box", "2.8; 0.8; 28.5 %", run.table_ii("box"), "measured by `wear`"]
    assert [row[0].partition(",")[0] for row in rows[5:]] == ["mean of the five", "mean"]
    assert rows[6][2] == "measured by `print`"


def test_of_two_commands_on_a_page_the_first_counts(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("### Same\n\n| a |\n|---|\n| 1 |\n\n### Same\n\n| a |\n|---|\n| 2 |\n", encoding="utf-8")
    assert tables_of(page) == {"Same": [{"a": "1"}]}


def test_what_is_not_there_names_its_command(run: Objects) -> None:
    assert run.table_ii("can") == run.mean() == "measured by `measure`"
    assert run.cell("Cells won, and p-values", "cells won", "here") == "measured by `measure`"
    assert Objects({}, "measure").ends() == "measured by `measure`"
    assert Objects({}, "measure").cells() == []


def test_a_source_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"nothing\.md"):
        tables_of(tmp_path / "nothing.md")


def test_the_papers_ratios_are_those_of_its_errors() -> None:
    assert RATIOS.keys() == TABLE_II.keys()
    for item, (km, ekm) in TABLE_II.items():
        assert RATIOS[item] == pytest.approx(100 * ekm / km, abs=0.1), item  # it cuts digits off
    assert mean_text(TABLE_II) == "1.62; 0.64; 40 %"


def test_joints_of_one_motor_are_compared_position_by_position() -> None:
    one = Coupled(np.arange(3.0), {}, {"a": np.array([0.0, 1.0, 2.0]), "b": np.array([0.0, 1.5, 2.0])})
    two = Coupled(np.arange(2.0), {}, {"c": np.array([0.0, 9.0]), "d": np.array([0.2, 9.0])})
    assert largest_difference({"one": one, "two": two}) == 0.5


def test_a_turn_ends_at_its_largest_angle() -> None:
    turn = FarTurn(np.array([0.0, 5.0, 30.0, 28.0]), np.zeros(4), None, "given up")  # type: ignore[arg-type]
    assert turn.end == 2


def test_pictures_of_one_figure_keep_their_scale() -> None:
    first, second = np.full((2, 6, 8, 3), 255, dtype=np.uint8)
    first[1, 2] = 0
    second[4, 5] = 0
    cropped = _cropped([first, second])
    assert [one.shape for one in cropped] == [(4, 4, 3)] * 2
    assert not cropped[0][0, 0].any()
    assert not cropped[1][-1, -1].any()
