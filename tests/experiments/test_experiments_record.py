"""Manipulations are logged whole, and alike whenever they are run."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil

import pytest
import torch

from torch_ekm.description.registry import object_paths
from torch_ekm.exceptions import ParameterError, SolverError, UnknownNameError
from torch_ekm.experiments.config import Setting
from torch_ekm.experiments.protocols.record import RecordConfig, record
from torch_ekm.experiments.runner import Bench
from torch_ekm.plant import Trajectory, TrialLog
from torch_ekm.simulation import PlantParameters

pytest.importorskip("sapien")
pytest.importorskip("h5py")

LEARNS = RecordConfig(
    Setting(hand="planar_two_finger", plant=PlantParameters(moment_arm=1.3)), controller="E-KM",
    object="can", angles_deg=(3.0, 5.0),
)  # fmt: skip


def digests(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_what_a_learner_did_is_the_same_after_an_interruption(tmp_path):
    """Its second turn depends on its first, which is then run again though its file is there."""
    log = record(LEARNS, (1,), tmp_path / "one")
    assert log.trials == (2, 3)
    outcome = log.read(2).about["outcome"]
    assert outcome["reason"] == "reached"
    assert len(outcome["errors_deg"]) == len(log.read(2).commands) + 1
    assert "seconds" not in outcome
    seen = []
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    (tmp_path / "two" / "trial_000003.h5").unlink()
    record(LEARNS, (1,), tmp_path / "two", seen.append)
    assert seen == [2, 3]
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    fresh = dataclasses.replace(LEARNS, angles_deg=(5.0,))
    alone = record(fresh, (1,), tmp_path / "three").read(1)
    assert not torch.equal(alone.commands[0], log.read(3).commands[0])  # so the test above can fail


def test_a_trial_that_fails_is_logged_with_what_happened_until_then(tmp_path, monkeypatch):
    def fail(self, seed, trial, angle):
        self.plant.reset(seed)
        raise SolverError("qp", "infeasible")

    monkeypatch.setattr(Bench, "trial", fail)
    log = record(RecordConfig(Setting(hand="planar_two_finger"), angles_deg=(3.0, 4.0)), (0,), tmp_path)
    assert [entry.reason for entry in log.index] == ["SolverError"] * 2
    assert len(log.read(1).observations) == 1
    assert "infeasible" in log.read(1).about["outcome"]["message"]


def test_impossible_records_are_refused():
    with pytest.raises(UnknownNameError, match=r"KM\+I"):
        RecordConfig(controller="PID")
    for angles in ((), (0.0,), (200.0,)):
        with pytest.raises(ParameterError, match="angles"):
            RecordConfig(angles_deg=angles)


def test_a_log_knows_the_files_that_it_was_made_from(tmp_path):
    for source, suffix in zip(object_paths("box"), (".urdf", ".object.toml"), strict=True):
        (tmp_path / f"mine{suffix}").write_bytes(source.read_bytes())
    mine = RecordConfig(object=str(tmp_path / "mine.urdf"))
    before = mine.configuration
    assert [name.partition(".")[0] for name in before["files"]] == ["hand icub_right_hand"] * 2 + [
        "object mine"
    ] * 2
    TrialLog(tmp_path / "log", before).close()
    with TrialLog(tmp_path / "log", before) as log:
        log.write(0, Trajectory())
    with (tmp_path / "mine.object.toml").open("a") as file:
        file.write("# corrected")
    with pytest.raises(ParameterError, match=r"configuration\['files'\]"):
        TrialLog(tmp_path / "log", mine.configuration)
