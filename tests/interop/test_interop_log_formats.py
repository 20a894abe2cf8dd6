"""Trials leave as .rrd and as a LeRobot dataset, and their own libraries read them back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ekm.exceptions import ParameterError
from torch_ekm.interop import log_to_lerobot
from torch_ekm.kinematics import se3
from torch_ekm.plant import Observation, PlantStatus, Trajectory, TrialLog

pytest.importorskip("h5py", reason="extra 'sim'")


def made_up(seed: int, n: int, n_a: int = 2) -> Trajectory:
    random = torch.Generator().manual_seed(seed)

    def some(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=random, dtype=torch.float64)

    seen = []
    for k in range(n + 1):
        info = {
            "raw": {"counts": torch.arange(4) + k, "image": torch.full((12, 9), k).byte()},
            "estimate": {"covariance": some(10, 10)},
        }
        if k == 1:
            info["events"] = ("a tendon slipped",)
        reading = some(4), some(n_a), some(3), se3.exp(some(3))
        status = PlantStatus.LOST if k == n else PlantStatus.HELD
        seen.append(Observation(*reading, some(2), 0.1 * k**2 + 0.3, status, info))
    return Trajectory(seed, [some(n_a) for _ in range(n)], seen, {"note": "made up"})


@pytest.fixture
def log(tmp_path: Path) -> TrialLog:
    log = TrialLog(tmp_path / "log", {"hand": "made up"})
    log.write(0, made_up(0, 3), {"reason": "done"})
    log.write(1, Trajectory(7), {"reason": "not grasped"})
    log.write(4, made_up(4, 5), {"reason": "done"})
    return log


def frames(log: TrialLog) -> list[tuple[Observation, torch.Tensor]]:
    """Observations, and the command after each; zeros at the end."""
    found = []
    for trial in (0, 4):
        read = log.read(trial)
        found += zip(read.observations, [*read.commands, torch.zeros(2).double()], strict=True)
    return found


def same(row, seen: Observation, command: torch.Tensor) -> None:
    pose = torch.cat([seen.position, se3.log(seen.rotation)])
    for name, value in (
        ("action", command),
        ("observation.state", torch.cat([seen.q, seen.a])),
        ("observation.environment_state", pose),
        ("observation.fingertip_force", seen.fingertip_force),
    ):
        read = torch.as_tensor(row[name], dtype=torch.float64)
        torch.testing.assert_close(read, value, rtol=1e-6, atol=1e-6)
    assert float(np.squeeze(row["observation.time"])) == pytest.approx(seen.time, abs=1e-6)


def test_a_dataset_has_a_frame_for_each_observation(log: TrialLog, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="extra 'interop'")
    folder = log_to_lerobot(log, tmp_path / "dataset", "turn it")
    rows = parquet.read_table(folder / "data/chunk-000/file-000.parquet").to_pylist()
    for row, (seen, command) in zip(rows, frames(log), strict=True):
        same(row, seen, command)
    assert [row["index"] for row in rows] == list(range(10))
    info = json.loads((folder / "meta/info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["robot_type"]) == ("v3.0", 2, "made up")
    stats = json.loads((folder / "meta/stats.json").read_text())["observation.time"]
    times = [seen.time for seen, _ in frames(log)]
    assert [stats["mean"][0], stats["max"][0]] == pytest.approx([np.mean(times), max(times)])
    with pytest.raises(ParameterError, match="does not exist yet"):
        log_to_lerobot(log, folder)


def test_a_dataset_is_of_one_hand(log: TrialLog, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="extra 'interop'")
    log.write(5, made_up(5, 2, n_a=3), {})
    with pytest.raises(ParameterError, match="all with the same joints"):
        log_to_lerobot(log, tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_lerobot_reads_the_dataset(log: TrialLog, tmp_path: Path) -> None:
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot, of the users' own")
    folder = log_to_lerobot(log, tmp_path / "dataset", "turn it")
    dataset = lerobot.LeRobotDataset("of/this", root=folder)
    assert (len(dataset), dataset.num_episodes, dataset.fps) == (10, 2, 1)
    for k, (seen, command) in enumerate(frames(log)):
        same(dataset[k], seen, command)
        assert dataset[k]["task"] == "turn it"
        assert int(dataset[k]["episode_index"]) == int(k >= 4)
    assert dataset.meta.episodes[1]["dataset_from_index"] == 4
    windows = lerobot.LeRobotDataset("of/this", root=folder, delta_timestamps={"action": [0.0, 1.0]})
    assert windows[3]["action_is_pad"].tolist() == [False, True], "an episode ends"
