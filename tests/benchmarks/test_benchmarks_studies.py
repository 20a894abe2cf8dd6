"""The studies: what they cover, and their reports."""

from __future__ import annotations

import csv
import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "experiments"))

pytest.importorskip("ablation", reason="the benchmarks are not part of this installation")

from ablation import DISTURBANCES, Ablation, variants
from foresight_study import Foresight
from foresight_turn import ForesightTurn
from made_up_sessions import made_up_generalize, made_up_turn
from oracle import run
from oracle import table as oracle_table

from torch_ekm.experiments.protocols.generalize import Generalize
from torch_ekm.experiments.reproduce import Experiment, reproduce
from torch_ekm.simulation import preset


def made_up_foresight(protocol: Foresight, item: str, contender: str, seed: int) -> list[ForesightTurn]:
    record, known = made_up_turn("E-KM", seed, 0, 70.0, item), {"contender": contender}
    far = dataclasses.replace(record, kind="far", reason="given up")
    dark = {"axis_std_deg": 0.4, "estimate_error_deg": 0.1 * seed, **known}
    reached = {"largest_deg": 30.0 + seed, "reach_deg": 31.0, "reach_end": "link: thumb_2", **known}
    return [
        ForesightTurn(**vars(far), **reached),
        ForesightTurn(**vars(made_up_turn("E-KM", seed, 1, 34.0, item)), **reached),
        ForesightTurn(**{**vars(record), "kind": "blind", "angle_deg": 15.0}, **dark),
    ]


@pytest.mark.parametrize("study", [Ablation(), Foresight()], ids=["ablation", "foresight"])
def test_report_is_complete(study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Generalize, "session", made_up_generalize)  # and with it the ablation's
    monkeypatch.setattr(Foresight, "session", made_up_foresight)
    report = reproduce(Experiment(study, (0, 1, 2)), tmp_path)
    for table in report.tables:
        with (tmp_path / f"{table.name}.csv").open() as stream:
            rows = list(csv.reader(stream))
        assert rows[0] == list(table.header)
        assert len(rows) == len(table.rows) + 1 > 1, table.name
    cells = [cell for table in report.tables for row in table.rows for cell in row]
    assert not any(isinstance(cell, float) and np.isnan(cell) for cell in cells)
    for figure in report.figures:
        assert (tmp_path / figure.path).stat().st_size > 1000
    assert "Development seeds" in report.summary


def test_ablation_covers_every_disturbance_of_the_nominal_plant() -> None:
    nominal, exact = preset("nominal"), preset("none")
    disturbed = {
        f.name for f in dataclasses.fields(nominal) if getattr(nominal, f.name) != getattr(exact, f.name)
    }
    assert disturbed == {name for names in DISTURBANCES.values() for name in names}
    protocol = Ablation()
    for variant in variants(protocol.setting):
        changed = protocol.setting.replace(**variant.changes)
        if variant.group == "disturbance":
            different = [
                name for name in disturbed if getattr(changed.parameters, name) != getattr(exact, name)
            ]
            assert set(different) == set(DISTURBANCES[variant.name]), variant.name
    jobs = protocol.jobs((0,))
    assert {(job.objects, job.angles_deg) for job, _, _ in jobs.values()} == {(("box",), (9.0, 19.0, 29.0))}
    # alike variants share their jobs
    assert len(jobs) < sum(len(v.controllers) for v in variants(protocol.setting))


def test_oracle_and_e_km_turn_the_same_objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Generalize, "session", made_up_generalize)
    rows = oracle_table(run(["tea_tin"], [0, 1], tmp_path, jobs=1)).rows
    assert {row[2] for row in rows} == {"E-KM", "oracle"}
    # knowledge of an oracle is of another description: it cannot be carried to the next object
    assert not any("new object" in file.name for file in tmp_path.glob("*.json"))
