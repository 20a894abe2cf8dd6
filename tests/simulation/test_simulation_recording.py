"""What was recorded comes back as it was."""

import dataclasses

import h5py
import pytest
import torch
from made_up import trajectory

from torch_ekm.exceptions import DescriptionError, ParameterError, StateError
from torch_ekm.plant import Plant, PlantStatus, ReplayedPlant, Trajectory
from torch_ekm.plant.trajectory import read_trial, write_trial
from torch_ekm.simulation import Tug

TUG = Tug(at=1, force=(0.0, 0.0, 5.0))


def record() -> Trajectory:
    """Four readings; the second one has an event of the simulator, and an object that no file keeps."""
    made, corners = trajectory(5), torch.full((2, 4, 2), torch.nan)
    more = {"events": (TUG,), "track": object()}
    for k, seen in enumerate(made.observations):
        info = {**seen.info, **(more if k == 1 else {}), "raw": {**seen.info["raw"], "corners": corners}}
        made.observations[k] = dataclasses.replace(seen, info=info)
    return made


def test_a_saved_recording_replays_like_the_original(tmp_path):
    original = record()
    replayed = ReplayedPlant(Trajectory.load(original.save(tmp_path / "run.h5")))
    assert isinstance(replayed, Plant)
    assert replayed.trajectory.seed == 5
    seen = [replayed.reset(0)] + [replayed.command(torch.zeros(2)) for _ in range(3)]
    for now, then in zip(seen, original.observations, strict=True):
        for name in ("q", "a", "position", "rotation", "fingertip_force"):
            assert torch.equal(getattr(now, name), getattr(then, name))
        assert (now.time, now.status) == (then.time, then.status)
        assert torch.equal(now.truth.q, then.truth.q)
        torch.testing.assert_close(now.info["raw"], then.info["raw"], rtol=0, atol=0, equal_nan=True)
        assert now.info["raw"]["image"].dtype == torch.uint8
    assert [o.info.get("events", ()) for o in seen] == [(), (str(TUG),), (), ()]
    assert [o.status for o in seen] == [PlantStatus.HELD] * 3 + [PlantStatus.LOST]
    with pytest.raises(StateError, match="the recording ends after"):
        replayed.command(torch.zeros(2))
    assert torch.equal(replayed.reset(0).q, original.observations[0].q)
    alone = Trajectory(9, [], original.observations[:1]).save(tmp_path / "alone.h5")
    assert ReplayedPlant(Trajectory.load(alone)).observe().status is PlantStatus.HELD


def test_a_hand_without_fingertip_sensors(tmp_path):
    made = record()
    blind = [dataclasses.replace(o, fingertip_force=None) for o in made.observations]
    made.observations = blind
    loaded = Trajectory.load(made.save(tmp_path / "run.h5"))
    assert [o.fingertip_force for o in loaded.observations] == [None] * 4
    with h5py.File(tmp_path / "run.h5") as file:
        assert "fingertip_force" not in file
    blind[1] = dataclasses.replace(blind[1], fingertip_force=torch.ones(2))
    with pytest.raises(StateError, match="fingertip_force"):
        made.save(tmp_path / "mixed.h5")


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
