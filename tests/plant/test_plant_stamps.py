"""When each sensor took its reading: what a plant says of it, and what wrappers and recordings keep."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from fakes import ScriptedPlant

from torch_ekm.plant import FramesAtRest, Observation, Stamps, Trajectory

Q = torch.zeros(2, dtype=torch.float64)
EYE = torch.eye(3, dtype=torch.float64)


def reading(time: float, pose: float | None = None) -> Observation:
    stamps = None if pose is None else Stamps(time, time, pose, time)
    return Observation(Q, Q, Q.new_zeros(3), EYE, time=time, stamps=stamps)


def test_all_readings_are_of_the_observations_time_unless_told() -> None:
    assert reading(3.0).taken == Stamps(3.0, 3.0, 3.0, 3.0)
    assert reading(3.0, 2.5).taken.pose == 2.5
    assert reading(3.0).dated
    assert reading(0.0, 0.0).dated
    assert not reading(0.0).dated


def test_the_mean_of_frames_is_no_newer_than_any_of_them() -> None:
    camera = ScriptedPlant(reading(5.0, pose) for pose in (4.9, 4.8, 5.0))
    seen = FramesAtRest(camera, 3).observe()
    assert seen.taken == Stamps(5.0, 5.0, 4.8, 5.0)


def test_a_recording_keeps_stamps_and_does_without(tmp_path) -> None:
    pytest.importorskip("h5py")
    dated = Trajectory(1, [Q], [reading(1.0, 1.0), reading(2.0, 1.0)])
    kept = Trajectory.load(dated.save(tmp_path / "dated.h5"))
    assert [o.stamps for o in kept.observations] == [o.stamps for o in dated.observations]
    bare = dataclasses.replace(dated, observations=[reading(1.0), reading(2.0)])
    kept = Trajectory.load(bare.save(tmp_path / "bare.h5"))
    assert [o.stamps for o in kept.observations] == [None, None]
