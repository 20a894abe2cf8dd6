"""A log loses at most the trial that was being run, and says what is wrong with it."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
import torch

from torch_ekm.exceptions import DescriptionError, GraspError, ParameterError, StateError
from torch_ekm.plant import RecordingPlant, Trajectory, TrialLog
from torch_ekm.plant.trial_log import TrialEntry
from torch_ekm.simulation import PlantParameters, SimulatedHand

pytest.importorskip("h5py")
pytest.importorskip("sapien")

CONFIGURATION = {"hand": "planar_two_finger", "noise": 0.001}


def digests(folder):
    """Of all files, by name."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def run(folder, trials, plant=None):
    """Short trials: a grasp and two commands, decided by the number of the trial alone."""
    log = TrialLog(folder, CONFIGURATION)
    parameters = PlantParameters(joint_noise=CONFIGURATION["noise"])
    plant = plant or RecordingPlant(SimulatedHand(CONFIGURATION["hand"], "box", parameters=parameters))
    for trial in log.missing(range(trials)):
        plant.reset(trial)
        for sign in (1, -1):
            plant.command(sign * torch.tensor([0.02, 0.01]))
        log.write(trial, plant.trajectory, {"reason": "done"})
    log.close()
    return log


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    run(folder, 4)
    return folder


def test_a_trial_says_all_about_itself(unbroken):
    log = TrialLog.open(unbroken)
    assert log.trials == (0, 1, 2, 3)
    assert 3 in log
    assert 4 not in log
    recording = log.read(2)
    assert (recording.seed, len(recording.commands), len(recording.observations)) == (2, 2, 3)
    assert recording.about["configuration"] == CONFIGURATION == log.configuration
    assert recording.about["outcome"] == {"reason": "done"}
    assert recording.about["trial"] == 2
    assert {"python", "torch", "sapien"} <= set(recording.about["versions"])
    assert recording.observations[-1].truth.q.shape == (4,)
    entry = log.index[2]
    last = recording.observations[-1]
    assert entry == TrialEntry(2, 2, 2, round(last.time, 6), "held", "done")


@pytest.mark.usefixtures("planned_anew")
def test_one_configuration_gives_one_log_byte_by_byte(unbroken, tmp_path):
    run(tmp_path, 4)
    assert digests(tmp_path) == digests(unbroken)
    assert len(set(digests(unbroken).values())) == 5  # and the trials differ


def test_a_run_in_pieces_gives_the_same_log(unbroken, tmp_path):
    run(tmp_path, 2)
    (tmp_path / "trial_000002.h5.part").write_bytes(b"killed while this was written")
    (tmp_path / "trial_000077.h5.part").write_bytes(b"killed in a longer run")
    run(tmp_path, 4)
    assert digests(tmp_path) == digests(unbroken)


def test_trials_that_are_written_meanwhile_are_seen(unbroken, tmp_path):
    run(tmp_path, 1)
    log = TrialLog.open(tmp_path)
    run(tmp_path, 2)
    assert [entry.trial for entry in log.index] == [0, 1]


def test_killed_while_writing_loses_the_current_trial_only(unbroken, tmp_path):
    """A real SIGKILL at a moment of its own choosing."""
    code = f"""
        import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
        from test_simulation_trial_log import run
        run({str(tmp_path)!r}, 4)
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)])
    deadline = time.monotonic() + 600
    while not (tmp_path / "trial_000001.h5").exists() and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    there = TrialLog.open(tmp_path).trials
    assert there[:2] == (0, 1)
    for trial in there:
        assert digests(tmp_path)[f"trial_{trial:06d}.h5"] == digests(unbroken)[f"trial_{trial:06d}.h5"]
    run(tmp_path, 4)
    assert digests(tmp_path) == digests(unbroken)


def test_a_grasp_that_failed_is_a_trial_too(tmp_path):
    class Clumsy(SimulatedHand):
        def reset(self, seed):
            raise GraspError("slippery")

    plant, log = RecordingPlant(Clumsy("planar_two_finger")), TrialLog(tmp_path, {})
    with pytest.raises(GraspError):
        plant.reset(7)
    log.write(0, plant.trajectory, {"reason": "not grasped"})
    assert log.index == (TrialEntry(0, 7, 0, 0.0, "not grasped", "not grasped"),)
    assert log.read(0).observations == []


def test_what_is_no_log_of_this_run_is_refused(unbroken, tmp_path):
    before = digests(unbroken)
    with pytest.raises(ParameterError, match=r"configuration\['noise'\] = 0.002.*0.001 as in the log"):
        TrialLog(unbroken, {**CONFIGURATION, "noise": 0.002})
    with pytest.raises(ParameterError, match="about"):
        TrialLog(tmp_path / "new", {"hand": object()})
    with pytest.raises(DescriptionError, match="no such log"):
        TrialLog.open(tmp_path / "nothing")
    with pytest.raises(DescriptionError, match="trial_000000"):
        TrialLog.open(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DescriptionError, match="is a file"):
        TrialLog(tmp_path / "file", {})
    log = TrialLog.open(unbroken)
    with pytest.raises(DescriptionError, match=r"no trial 9; there are 0, 1, 2, 3"):
        log.read(9)
    with pytest.raises(StateError, match="closed, or opened to be read"):
        log.write(9, Trajectory())
    log = TrialLog(unbroken, CONFIGURATION)
    with pytest.raises(ParameterError, match="not in the log yet"):
        log.write(3, Trajectory())
    with pytest.raises(ParameterError, match="trial"):
        log.write(-1, Trajectory())
    log.close()
    assert digests(unbroken) == before


def test_a_damaged_trial_is_named(unbroken, tmp_path):
    for path in unbroken.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    torn = tmp_path / "trial_000001.h5"
    torn.write_bytes(torn.read_bytes()[:2000])
    log = TrialLog.open(tmp_path)
    assert log.read(2).seed == 2
    with pytest.raises(DescriptionError, match=r"trial_000001\.h5: damaged"):
        log.read(1)
    assert [entry.trial for entry in log.index] == [0, 2, 3]
    before = torn.read_bytes()
    with pytest.warns(UserWarning, match=r"trial_000001\.h5: damaged.*kept as trial_000001\.h5\.damaged"):
        assert run(tmp_path, 4).trials == (0, 1, 2, 3)
    aside = tmp_path / "trial_000001.h5.damaged"
    assert aside.read_bytes() == before
    aside.unlink()
    assert digests(tmp_path) == digests(unbroken)


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
@pytest.mark.timeout(60)
def test_what_is_no_file_is_refused_at_once(tmp_path):
    """A pipe would be waited for, a device be read for ever."""
    os.mkfifo(tmp_path / "trial_000000.h5")
    (tmp_path / "trial_000001.h5").symlink_to("/dev/zero")
    for trial in range(2):
        with pytest.raises(DescriptionError, match="no recording: it is no file"):
            Trajectory.load(tmp_path / f"trial_{trial:06d}.h5")
    with pytest.raises(DescriptionError, match="no file but"):
        TrialLog.open(tmp_path)
