"""What was recorded comes back as it was."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from fakes import FakePlant

from torch_ekm.exceptions import DescriptionError, ParameterError, StateError
from torch_ekm.plant import Observation, Plant, PlantStatus, RecordingPlant, ReplayedPlant, Trajectory, Truth
from torch_ekm.plant.trajectory import read_trial, write_trial
from torch_ekm.simulation import Tug

h5py = pytest.importorskip("h5py")


class Counter(FakePlant):
    """Any plant will do: one whose readings count the commands."""

    def __init__(self):
        self.state = torch.zeros(3, dtype=torch.float64)

    def reset(self, seed):
        self.state = torch.full((3,), float(seed), dtype=torch.float64)
        return self.observe()

    def observe(self):
        status = PlantStatus.LOST if self.state[0] > 8 else PlantStatus.HELD
        eye = torch.eye(3, dtype=torch.float64)
        info = {
            "raw": {"hall": self.state.to(torch.uint8), "corners": torch.full((2, 4, 2), torch.nan)},
            "track": object(),  # not kept
        }
        if self.state[0] == 7:
            info["events"] = (Tug(at=1, force=(0.0, 0.0, 5.0)),)
        return Observation(
            *(
                self.state,
                self.state[:2],
                self.state,
                eye,
                self.state[:1],
                float(self.state[0]),
                status,
                info,
            ),
            truth=Truth(self.state + 0.5, self.state, eye),
        )

    def move(self, delta_a):
        self.state = self.state + delta_a


def record():
    plant = RecordingPlant(Counter())
    plant.reset(1)
    plant.command(torch.ones(3))  # belongs to an earlier grasp
    plant.reset(5)
    for k in range(3):
        plant.command(torch.tensor([1.0, 2.0, k]))
    return plant.trajectory


def test_a_saved_recording_replays_like_the_original(tmp_path):
    original = record()
    replayed = ReplayedPlant(Trajectory.load(original.save(tmp_path / "run.h5")))
    assert isinstance(replayed, Plant)
    assert replayed.trajectory.seed == 5
    seen = [replayed.reset(0)] + [replayed.command(torch.zeros(3)) for _ in range(3)]
    for now, then in zip(seen, original.observations, strict=True):
        for name in ("q", "a", "position", "rotation", "fingertip_force"):
            assert torch.equal(getattr(now, name), getattr(then, name))
        assert (now.time, now.status) == (then.time, then.status)
        assert torch.equal(now.truth.q, then.truth.q)
        torch.testing.assert_close(now.info["raw"], then.info["raw"], rtol=0, atol=0, equal_nan=True)
        assert now.info["raw"]["hall"].dtype == torch.uint8
    assert [o.info.get("events", ()) for o in seen] == [(), (), (str(Tug(at=1, force=(0.0, 0.0, 5.0))),), ()]
    assert [o.status for o in seen] == [PlantStatus.HELD] * 4
    with pytest.raises(StateError, match="the recording ends after"):
        replayed.command(torch.zeros(3))
    assert torch.equal(replayed.reset(0).q, original.observations[0].q)


def test_a_hand_without_fingertip_sensors(tmp_path):
    trajectory = record()
    blind = [dataclasses.replace(o, fingertip_force=None) for o in trajectory.observations]
    trajectory.observations = blind
    loaded = Trajectory.load(trajectory.save(tmp_path / "run.h5"))
    assert [o.fingertip_force for o in loaded.observations] == [None] * 4
    with h5py.File(tmp_path / "run.h5") as file:
        assert "fingertip_force" not in file
    blind[1] = dataclasses.replace(blind[1], fingertip_force=torch.ones(1))
    with pytest.raises(StateError, match="fingertip_force"):
        trajectory.save(tmp_path / "mixed.h5")


def test_a_recording_without_commands(tmp_path):
    plant = RecordingPlant(Counter())
    plant.reset(9)
    loaded = Trajectory.load(plant.trajectory.save(tmp_path / "run.h5"))
    assert loaded.commands == []
    assert ReplayedPlant(loaded).observe().status is PlantStatus.LOST


def test_what_is_not_a_recording_is_refused(tmp_path):
    with pytest.raises(DescriptionError, match="no such recording"):
        Trajectory.load(tmp_path / "nothing.h5")
    (tmp_path / "text.h5").write_text("not HDF5")
    with pytest.raises(DescriptionError, match="damaged"):
        Trajectory.load(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(DescriptionError, match="not a recording"):
        Trajectory.load(tmp_path / "other.h5")
    path = record().save(tmp_path / "run.h5")
    seed, about, arrays = read_trial(path)
    del arrays["q"]  # and a digest that is right
    write_trial(path, seed, about, arrays)
    with pytest.raises(DescriptionError, match="damaged"):
        Trajectory.load(path)
    for about, match in (({"x": object()}, "about"), ({"x": {1, 2}}, "about")):
        with pytest.raises(ParameterError, match=match):
            Trajectory(about=about).save(tmp_path / "never.h5")
    ragged = record()
    ragged.observations[1].info["raw"] = {"hall": torch.zeros(5)}
    with pytest.raises(StateError, match="raw/"):
        ragged.save(tmp_path / "never.h5")
    assert not list(tmp_path.glob("never*"))
    with pytest.raises(StateError, match="the trajectory is empty"):
        ReplayedPlant(Trajectory())


def test_any_flipped_byte_is_noticed(tmp_path):
    """Of data, description, and of the space that HDF5 leaves unused."""
    path = record().save(tmp_path / "run.h5")
    whole = path.read_bytes()
    for place in range(0, len(whole), 97):
        damaged = bytearray(whole)
        damaged[place] ^= 0x55
        path.write_bytes(damaged)
        with pytest.raises(DescriptionError, match="damaged"):
            Trajectory.load(path)


def test_the_last_reading_before_a_command_is_the_one_that_counts():
    """What a controller acted on; what had happened stays noted."""
    plant = RecordingPlant(Counter())
    plant.observe()  # nothing is recorded before a reset
    plant.reset(6)
    plant.command(torch.ones(3))
    plant.plant.state = plant.plant.state + 0.25  # another reading
    seen = plant.observe()
    kept = plant.trajectory.observations
    assert [float(o.q[0]) for o in kept] == [6.0, 7.25]
    assert kept[-1].info["events"] == seen.info["events"] == (Tug(at=1, force=(0.0, 0.0, 5.0)),)
